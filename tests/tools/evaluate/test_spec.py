"""An evaluation of one's own: what its file may say, and what it is told where it errs."""

from __future__ import annotations

import re
from pathlib import Path

import pytest

from servoid.hw.config import ConfigError, available
from servoid.tools.cli import main
from servoid.tools.evaluate.metrics import METRICS, Metric
from servoid.tools.evaluate.spec import Beside, load_evaluation

MINE = """\
title: Mine
networks:
  wide: {train: --width 256, latents: true}
experiments:
  far: {task: goal-far, set: {radius: 0.1}, plan: {steps: 5, guidance.choose: best}, episodes: 20}
  own: {like: far, set: {seconds: 30}, plan: {steps: 3}, network: wide}
  loop: {like: pool}
  pool: {like: loop}
variants:
  randomised: {randomise: true}
  slow: {like: far, plan: {delay: 4}}
rows:
  mine/far: {title: Far, experiment: far, metric: success, figure: 0.9, variants: [randomised, slow], note: as it is}
  mine/own: {title: Own, experiment: own, metric: success, figure: {row: mine/far, factor: 1.1}}
  mine/way: {title: Way, experiment: {task: walk, policy: gait}, metric: {of: distance_m, unit: m}, paper: Nobody's}
left_out: [the rest]
"""


def written(folder: Path, text: str = MINE) -> Path:
    path = folder / "mine.yaml"
    path.write_text(text)
    return path


def test_rows_are_what_the_file_says(tmp_path: Path) -> None:
    mine = load_evaluation(written(tmp_path))
    assert (mine.name, mine.title, mine.left_out) == ("mine", "Mine", ("the rest",))
    far, own, way, randomised, _ = mine.rows
    assert far.experiment.set == {"radius": "0.1"}
    assert far.experiment.plan == {"steps": "5", "guidance.choose": "best"}
    assert far.metric == METRICS["success"]
    assert (far.experiment.episodes, way.experiment.episodes) == (20, 100)
    assert own.figure == Beside("mine/far", 1.1)
    assert (way.paper, way.experiment.policy, way.metric) == ("Nobody's", "gait", Metric("distance_m", "m"))
    assert (randomised.name, randomised.title) == ("mine/far@randomised", "Far (randomised)")
    assert (randomised.figure, randomised.quick, randomised.note) == (None, False, "as it is")


def test_an_experiment_like_another_differs_in_what_it_says(tmp_path: Path) -> None:
    far, own, _, randomised, slow = (row.experiment for row in load_evaluation(written(tmp_path)).rows)
    assert own.set == {"radius": "0.1", "seconds": "30"}
    assert own.plan == {"steps": "3", "guidance.choose": "best"}
    assert own.network is not None
    assert (own.network.name, own.network.train, own.network.latents) == ("wide", "--width 256", True)
    assert (own.task, own.episodes) == ("goal-far", 20)
    assert (randomised.plan, randomised.randomise) == (far.plan, True)
    assert slow.plan == {**far.plan, "delay": "4"}


@pytest.mark.parametrize(
    ("was", "becomes", "told"),
    [
        ("metric: success, figure: 0.9", "metric: sucess", "13: rows.mine/far.metric: unknown metric 'sucess'; did"),
        ("experiment: own", "experiment: owm", "14: rows.mine/own.experiment: unknown experiment 'owm'; did"),
        ("network: wide", "network: wild", "14: rows.mine/own.experiment: unknown network 'wild'; did"),
        ("like: far, set", "like: loop, set", "8: experiments.pool.like: experiment 'loop' is like itself"),
        ("row: mine/far", "row: mine/fat", "14: rows.mine/own.figure.row: unknown row 'mine/fat'; did"),
        ("[randomised, slow]", "[randomized]", "13: rows.mine/far.variants: unknown variant 'randomized'; did"),
        ("title: Own", "titel: Own", "14: rows.mine/own.titel: unknown key; did you mean 'title'?"),
        ("task: walk", "task: wlak", "15: rows.mine/way.experiment: unknown task 'wlak': did you mean 'walk'?"),
        ("policy: gait", "policy: gate", "15: rows.mine/way.experiment: unknown policy 'gate'"),
        ("{radius: 0.1}", "{raduis: 0.1}", "13: rows.mine/far.experiment: --set raduis=0.1: unknown setting"),
        ("plan: {steps: 3}", "plan: {stpes: 3}", "14: rows.mine/own.experiment: plan: unknown setting 'stpes'"),
        ("best}", "best, guidance.x: 1}", "13: rows.mine/far.experiment: plan: unknown setting 'guidance.x'"),
        ("task: walk,", "", "15: rows.mine/way.experiment: names no task"),
        ("episodes: 20", "episodes: 0", "13: rows.mine/far.experiment: episodes must be at least 1, not 0"),
        ("policy: gait", "backend: dynamixel", "15: rows.mine/way.experiment: backend 'dynamixel' has no truth"),
        ("rows:", "row:", "12: row: unknown key; did you mean 'rows'?"),
    ],
)
def test_mistakes_are_told_with_file_line_and_key(tmp_path: Path, was: str, becomes: str, told: str) -> None:
    assert MINE.count(was) == 1
    with pytest.raises(ConfigError) as caught:
        load_evaluation(written(tmp_path, MINE.replace(was, becomes)))
    assert str(caught.value).startswith(f"{tmp_path / 'mine.yaml'}:{told}")


def test_the_command_takes_a_file_of_ones_own(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    mine, out = written(tmp_path), tmp_path / "out"
    words = ["evaluate", str(mine), "--rows", "mine/way", "--seconds", "1", "--episodes", "1", "--workers", "1"]
    assert main([*words, "--out", str(out)]) == 0
    shown = capsys.readouterr().out
    assert "Nobody's" in shown
    assert "the rest" in shown
    assert (out / "mine.md").read_text().startswith("# Mine")
    assert (out / "mine.csv").is_file()
    assert main([*words[:1], "paper"]) == 2
    assert "did you mean 'papers'" in capsys.readouterr().err


def test_the_example_of_the_documentation_is_one(tmp_path: Path) -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "evaluation.md").read_text()
    (text,) = re.findall(r"^```yaml\n(.*?)^```$", page, re.MULTILINE | re.DOTALL)
    rows = load_evaluation(written(tmp_path, text)).rows
    assert [row.name for row in rows] == ["mine/goal", "mine/slow", "mine/way", "mine/goal@randomised"]
    for name in METRICS:
        assert f"`{name}`" in page


def test_every_shipped_evaluation_can_be_read() -> None:
    for name in available("evaluation"):
        assert load_evaluation(name).rows

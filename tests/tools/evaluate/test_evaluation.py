"""Evaluations go on where they were, do nothing twice, and notice what changed."""

from __future__ import annotations

import json
import shutil
from collections.abc import Callable, Sequence
from functools import partial
from pathlib import Path
from typing import Any

import pytest

from servoid.hw.config import CONFIGS, ConfigError
from servoid.hw.contracts.body import BackendError
from servoid.hw.seeds import episode_seed
from servoid.policy.checkpoint import resolve
from servoid.stack.runtime.run import RunSettings
from servoid.tools.cli import main
from servoid.tools.evaluate import code_hash
from servoid.tools.evaluate import judge as judging
from servoid.tools.evaluate.cache import EpisodeCache
from servoid.tools.evaluate.episode import EpisodeJob, EpisodeResult, do_episode
from servoid.tools.evaluate.metrics import METRICS
from servoid.tools.evaluate.report import Measured
from servoid.tools.evaluate.runner import Interrupted, Options
from servoid.tools.evaluate.runner import evaluate as evaluate_with
from servoid.tools.evaluate.spec import Experiment, Row

SUCCESS = METRICS["success"]
NEAR = Row("t/near", "Near", Experiment("goal-near", episodes=4), SUCCESS)
FALLS = Row("t/falls", "Falls", Experiment("goal-near", episodes=4), METRICS["falls"])
FAR = Row("t/far", "Far", Experiment("goal-far", episodes=2), SUCCESS)


class Episodes:
    """Does episodes as they are asked for, but runs none of them really."""

    def __init__(self) -> None:
        self.jobs: list[EpisodeJob] = []

    def __call__(self, job: EpisodeJob) -> EpisodeResult:
        self.jobs.append(job)
        if job.settings.task == "stand":
            return EpisodeResult(job, {}, "the floor is missing")
        return EpisodeResult(job, {"success": True, "fell": False, "outcome": "succeeded", "seed": job.settings.seed})


def evaluate(rows: Sequence[Row], options: Options, work: Callable[[EpisodeJob], EpisodeResult]) -> dict[str, Measured]:
    return evaluate_with(rows, options, quiet, work)


@pytest.fixture
def done() -> Episodes:
    return Episodes()


def options(out: Path, **more: Any) -> Options:
    return Options(out=out, policy="gait", workers=1, **more)


def quiet(text: str) -> None:
    """Say nothing."""


def test_episodes_are_done_in_turns_once_for_all_rows_that_share_them(tmp_path: Path, done: Episodes) -> None:
    measured = evaluate([NEAR, FALLS, FAR], options(tmp_path), done)
    order = [(job.settings.task, job.episode) for job in done.jobs]
    assert order == [
        ("goal-near", 0),
        ("goal-far", 0),
        ("goal-near", 1),
        ("goal-far", 1),
        ("goal-near", 2),
        ("goal-near", 3),
    ]
    assert measured["t/near"].records == measured["t/falls"].records
    assert len({job.settings.seed for job in done.jobs if job.settings.task == "goal-near"}) == 4


def test_what_was_done_is_not_done_again(tmp_path: Path, done: Episodes) -> None:
    evaluate([NEAR], options(tmp_path, episodes=2), done)
    assert len(done.jobs) == 2
    first = evaluate([NEAR], options(tmp_path), done)
    assert [job.episode for job in done.jobs] == [0, 1, 2, 3]
    assert evaluate([NEAR], options(tmp_path), done) == first
    assert len(done.jobs) == 4
    evaluate([NEAR], options(tmp_path, fresh=True), done)
    assert len(done.jobs) == 8


def test_a_half_written_line_is_done_again_and_the_file_stays_whole(tmp_path: Path, done: Episodes) -> None:
    evaluate([NEAR], options(tmp_path), done)
    (path,) = (tmp_path / "episodes").glob("*.jsonl")
    path.write_text(path.read_text()[:-20])  # as a kill in the middle of a write leaves it
    evaluate([NEAR], options(tmp_path), done)
    assert [job.episode for job in done.jobs] == [0, 1, 2, 3, 3]
    lines = [json.loads(line) for line in path.read_text().splitlines()]
    assert [line["episode"] for line in lines[1:]] == [0, 1, 2, 3]


@pytest.mark.parametrize("change", [{"seed": 1}, {"seconds": 5.0}])
def test_other_settings_are_other_episodes(tmp_path: Path, done: Episodes, change: dict[str, Any]) -> None:
    evaluate([NEAR], options(tmp_path), done)
    evaluate([NEAR], options(tmp_path, **change), done)
    assert len(done.jobs) == 8


def test_quick_cuts_the_longest_episodes_and_does_not_mistake_them_for_whole_ones(
    tmp_path: Path, done: Episodes
) -> None:
    row = Row("t/velocity", "Velocity", Experiment("velocity", episodes=1, quick_seconds=61.0), SUCCESS)
    evaluate([row], options(tmp_path, quick=True), done)
    evaluate([row], options(tmp_path), done)
    evaluate([row], options(tmp_path, quick=True, seconds=5.0), done)
    assert [job.settings.seconds for job in done.jobs] == [61.0, None, 5.0]


def test_episodes_are_not_those_that_settings_are_tried_on(tmp_path: Path, done: Episodes) -> None:
    evaluate([NEAR, FAR], options(tmp_path), done)
    seeds = {
        run: [job.settings.seed for job in done.jobs if job.settings.task == run] for run in ("goal-near", "goal-far")
    }
    assert seeds["goal-near"][:2] == seeds["goal-far"]  # the same for every row
    assert not set(seeds["goal-near"]) & {episode_seed(0, episode) for episode in range(100)}


def test_what_changes_meanwhile_ends_the_evaluation(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Each episode reads checkpoint, settings and robot anew; it would be kept under what they were before."""
    checkpoint, robot = tmp_path / "mine.safetensors", tmp_path / "robots" / "mine.yaml"
    shutil.copy(resolve("diffusion"), checkpoint)
    shutil.copytree(CONFIGS, tmp_path / "configs")
    shutil.copytree(CONFIGS / "robots", tmp_path / "robots")
    shutil.copy(CONFIGS / "robots" / "op3.yaml", robot)
    code_hash.code()  # that of this program, once and for all
    module = tmp_path / "hw" / "module.py"
    for path in (module, *(tmp_path / judge for judge in code_hash.JUDGES)):
        path.parent.mkdir(parents=True, exist_ok=True)
        path.touch()
    monkeypatch.setattr(code_hash, "ROOT", tmp_path)
    changes = [
        lambda job: checkpoint.write_bytes(checkpoint.read_bytes()[:-4] + b"\0\0\0\1"),
        lambda job: robot.write_text(robot.read_text().replace("name: op3", "name: mine")),
        lambda job: (tmp_path / "configs" / "tasks" / "goal-near.yaml").open("a").write("# another\n"),
        lambda job: Path(job.settings.policy).write_text("steps: 3\n"),
        lambda job: module.write_text("edited = True\n"),
    ]
    for number, change in enumerate(changes):

        def do(job: EpisodeJob, change: Any = change) -> EpisodeResult:
            change(job)
            return EpisodeResult(job, {"success": True})

        out = tmp_path / str(number)
        with pytest.raises(ConfigError, match="changed while"):
            evaluate([NEAR], Options(out, policy=str(checkpoint), robot=str(robot), workers=1), do)
        assert not any('"episode"' in path.read_text() for path in (out / "episodes").glob("*.jsonl"))


def test_settings_of_the_planner_stay_those_of_the_start(tmp_path: Path) -> None:
    from servoid.policy.diffusion.settings import load_settings

    mine = tmp_path / "mine.yaml"
    mine.write_text("checkpoint: diffusion\nexecution_horizon: 6\n")
    ran = []

    def do(job: EpisodeJob) -> EpisodeResult:
        ran.append(load_settings(job.settings.policy).execution_horizon)
        mine.write_text("checkpoint: diffusion\nexecution_horizon: 8\n")
        return EpisodeResult(job, {"success": True})

    evaluate([NEAR], Options(tmp_path, policy=str(mine), workers=1), do)
    assert ran == [6, 6, 6, 6]


def test_a_row_that_cannot_be_done_does_not_stop_the_others(tmp_path: Path, done: Episodes) -> None:
    stand = Row("t/stand", "Stand", Experiment("stand", episodes=3), SUCCESS)
    variant = Row("t/variant", "Variant", Experiment("goal-near", plan={"execution_horizon": "8"}), SUCCESS)
    measured = evaluate([stand, variant, FAR], options(tmp_path), done)
    assert measured["t/stand"].refused == "the floor is missing"
    assert sum(job.settings.task == "stand" for job in done.jobs) == 1
    assert "for diffusion models" in (measured["t/variant"].refused or "")
    assert len(measured["t/far"].records) == 2


@pytest.mark.parametrize("error", [BackendError("the rig did not answer"), ZeroDivisionError("no floor")])
def test_an_error_of_one_run_does_not_stop_the_others(tmp_path: Path, error: Exception) -> None:
    def record(settings: RunSettings) -> dict[str, Any]:
        if settings.task == "goal-far":
            raise error
        return {"success": True}

    measured = evaluate([FAR, NEAR], options(tmp_path), partial(do_episode, do=record))
    assert str(error) in (measured["t/far"].refused or "")
    assert len(measured["t/near"].records) == 4


def test_no_time_at_all_tells_what_was_done(tmp_path: Path, done: Episodes) -> None:
    evaluate([NEAR], options(tmp_path, episodes=1), done)
    measured = evaluate([NEAR, FAR], options(tmp_path, minutes=0), done)
    assert [len(measured[row.name].records) for row in (NEAR, FAR)] == [1, 0]
    assert len(done.jobs) == 1


def test_no_time_at_all_records_no_clips_and_forgets_nothing(tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    words = ["evaluate", "papers", "--minutes", "0", "--out", str(tmp_path), "--rows", "cloc/inbetween"]
    assert main(words) == 0
    assert not (tmp_path / "clips").exists()
    assert main([*words, "--fresh"]) == 2
    assert "--fresh" in capsys.readouterr().err


def test_where_nothing_was_measured_the_page_that_is_there_stays(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    words = ["evaluate", "papers", "--policy", "gait", "--out", str(tmp_path), "--rows"]
    assert main([*words, "cloc/attention-full"]) == 0
    out = capsys.readouterr().out
    assert "needs training" in out
    assert "nothing was measured" in out
    assert not (tmp_path / "papers.md").exists()
    (tmp_path / "papers.md").write_text("of an evaluation before")
    assert main([*words, "uniphys/goal-near", "--minutes", "0"]) == 0
    assert (tmp_path / "papers.md").read_text() == "of an evaluation before"


def test_an_episode_that_ctrl_c_ended_is_not_kept(tmp_path: Path) -> None:
    """The run takes the signal for itself, and ends in good order: nothing else would tell the evaluation."""

    def record(settings: RunSettings) -> dict[str, Any]:
        raise KeyboardInterrupt

    with pytest.raises(KeyboardInterrupt):
        evaluate([NEAR], options(tmp_path), partial(do_episode, do=record))
    assert not any('"episode"' in path.read_text() for path in (tmp_path / "episodes").glob("*.jsonl"))


def test_after_ctrl_c_the_figures_are_of_what_was_done(
    tmp_path: Path, done: Episodes, capsys: pytest.CaptureFixture[str]
) -> None:
    def until_the_third(job: EpisodeJob) -> EpisodeResult:
        if len(done.jobs) == 3:
            raise KeyboardInterrupt
        return done(job)

    with pytest.raises(Interrupted, match="the same command goes on") as caught:
        evaluate([NEAR, FAR], options(tmp_path), until_the_third)
    assert {name: len(one.records) for name, one in caught.value.measured.items()} == {"t/near": 2, "t/far": 1}
    assert len(evaluate([NEAR, FAR], options(tmp_path), done)["t/near"].records) == 4
    assert len(done.jobs) == 6


@pytest.mark.slow
def test_the_command_prints_and_writes_what_was_done_until_ctrl_c(
    tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    judged = judging.judge
    seen = []

    def judge(settings: RunSettings) -> judging.Judged:
        if seen:
            raise KeyboardInterrupt
        seen.append(settings)
        return judged(settings)

    monkeypatch.setattr(judging, "judge", judge)
    words = [
        "evaluate",
        "papers",
        "--policy",
        "gait",
        "--rows",
        "uniphys/goal-near",
        "--seconds",
        "1",
        "--workers",
        "1",
    ]
    assert main([*words, "--episodes", "2", "--out", str(tmp_path), "--json"]) == 130
    captured = capfd.readouterr()
    answer = json.loads(captured.out)
    assert (answer["exit_code"], answer["rows"][0]["episodes"]) == (130, 1)
    assert "the same command goes on" in answer["error"]
    assert "| 1 |" in (tmp_path / "papers.md").read_text()


def test_a_cache_that_cannot_be_written_says_so(tmp_path: Path) -> None:
    (tmp_path / "file").write_text("")
    with pytest.raises(ConfigError, match="--out"):
        EpisodeCache(tmp_path / "file" / "a.jsonl", {"a": 1})


@pytest.mark.slow
def test_the_command_from_episodes_to_pictures(tmp_path: Path, capfd: pytest.CaptureFixture[str]) -> None:
    """A real one, two seconds long, with a pillar or two; and again, from what was kept."""
    words = [
        "evaluate",
        "papers",
        "--rows",
        "uniphys/goal-near",
        "cloc/forest",
        "cloc/attention-full",
        "--policy",
        "gait",
    ]
    words += ["--episodes", "1", "--seconds", "2", "--workers", "1", "--out", str(tmp_path), "--json"]
    assert main(words) == 0
    (line,) = capfd.readouterr().out.splitlines()
    first = json.loads(line)
    assert {"paper", "row", "published", "figure", "value", "ci95", "episodes", "reached"} <= set(first["rows"][0])
    rows = {row["name"]: row for row in first["rows"]}
    assert [rows[name]["episodes"] for name in ("uniphys/goal-near", "cloc/forest", "cloc/attention-full")] == [1, 1, 0]
    assert rows["cloc/attention-full"]["value"] is None
    assert "--mask full" in rows["cloc/attention-full"]["note"]
    assert "jump" in " ".join(first["left_out"]).lower()
    page = (tmp_path / "papers.md").read_text()
    assert "Goal, near: success" in page
    assert "cut to 2 s" in page
    assert (tmp_path / "papers.csv").read_text().count("\n") == 1 + len(rows)
    for name in ("paths-uniphys-goal-near.png", "paths-cloc-forest.png"):
        assert (tmp_path / name).read_bytes().startswith(b"\x89PNG")
        assert name in page
    kept = [json.loads(path.read_text().splitlines()[1]) for path in (tmp_path / "episodes").glob("*.jsonl")]
    forest = next(record for record in kept if len(record["pillars"]))
    assert len(forest["pillars"]) == 15
    assert forest["ticks"] == 100
    assert forest["motion"]["jerk_mps3"] > 0
    main(words)
    (line,) = capfd.readouterr().out.splitlines()
    assert json.loads(line)["rows"] == first["rows"]


@pytest.mark.parametrize(
    ("words", "named"),
    [
        (["--rows", "uniphys/gaol-near"], "uniphys/goal-near"),
        (["--episodes", "0"], "--episodes"),
        (["--minutes", "-1"], "--minutes"),
        (["--policy", "gate"], "gait"),
        (["--robot", "op4"], "op4"),
    ],
)
def test_bad_choices_are_refused(words: list[str], named: str, tmp_path: Path, capsys: pytest.CaptureFixture) -> None:
    assert main(["evaluate", "papers", "--out", str(tmp_path), *words]) == 2
    assert named in capsys.readouterr().err


def test_the_text_encoder_is_measured_apart() -> None:
    from servoid.policy.text.captions import MOTIONS
    from servoid.tools.commands.evaluate import encoder_accuracy

    result = encoder_accuracy()
    assert result["phrasings"] == sum(len(motion.held_out) for motion in MOTIONS)
    assert result["accuracy"] > 0.95  # it reads all 58 of them

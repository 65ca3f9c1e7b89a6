"""Datasets of logs are LeRobot's, with quantiles and films, take episodes of other runs, and training reads them."""

from __future__ import annotations

import json
import subprocess
import sys
from pathlib import Path

import numpy as np
import pyarrow.parquet as pq
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.policy.recording import read_recording
from servoid.stack.log.flightlog import read_log
from servoid.stack.runtime.run import RunSettings, run
from servoid.tools import cli
from servoid.tools.learn.dataset.lerobot import DatasetWriter
from servoid.tools.learn.dataset.reader import read_dataset
from servoid.tools.learn.dataset.schema import Feature, Schema
from servoid.tools.learn.dataset.statistics import QUANTILES, statistics, together


@pytest.fixture(scope="module")
def logs(tmp_path_factory: pytest.TempPathFactory) -> list[Path]:
    """Two short walks."""
    folder = tmp_path_factory.mktemp("logs")
    paths = [folder / f"walk-{seed}.mcap" for seed in (1, 2)]
    for seed, path in enumerate(paths):
        run(RunSettings(task="walk", policy="gait", seconds=2.0, seed=seed, record=path))
    return paths


def added(out: Path, *words: object) -> None:
    assert cli.main(["dataset", "add", str(out), *map(str, words), "--json"]) == 0


def refused(capsys: pytest.CaptureFixture[str], *words: object) -> str:
    assert cli.main(["dataset", *map(str, words), "--json"]) == 2
    return str(json.loads(capsys.readouterr().out)["error"])


def test_logs_become_episodes_that_training_reads(logs: list[Path], tmp_path: Path) -> None:
    out, robot = tmp_path / "runs", load_robot()
    added(out, *logs, "--licence", "Apache-2.0", "--task", "walk forward")
    dataset = read_dataset(out)
    assert (len(dataset.episodes), dataset.tasks) == (2, ("walk forward",))
    recording, log = read_recording(out, robot), read_log(logs[0])
    first = slice(*recording.spans[0])
    ticks = log.ticks("/instruction")
    np.testing.assert_array_equal(
        recording.applied[first], log.column("/command", "position")[np.isin(log.ticks("/command"), ticks)].astype("f4")
    )
    np.testing.assert_array_equal(
        recording.raw[first, :3], log.column("/state", "displacement")[np.isin(log.ticks("/state"), ticks)]
    )


def test_a_dataset_is_appended_to_and_nothing_is_taken_twice(logs: list[Path], tmp_path: Path) -> None:
    once, twice = tmp_path / "once", tmp_path / "twice"
    added(once, *logs, "--licence", "Apache-2.0")
    added(twice, logs[0], "--licence", "Apache-2.0")
    added(twice, *logs, "--task", "another name")
    at_once, in_turn = read_dataset(once), read_dataset(twice)
    assert in_turn.tasks == ("walk", "another name")
    assert [row["length"] for row in in_turn.episodes] == [row["length"] for row in at_once.episodes]
    for name in ("observation.state", "action", "index", "frame_index", "episode_index"):
        np.testing.assert_array_equal(in_turn.columns([name])[name], at_once.columns([name])[name])
        a, b = (json.loads((folder / "meta" / "stats.json").read_text())[name] for folder in (once, twice))
        assert a == b
    added(twice, *logs)  # both are there
    assert len(read_dataset(twice).episodes) == 2


def test_quantiles_are_those_of_the_frames(logs: list[Path], tmp_path: Path) -> None:
    out = tmp_path / "runs"
    added(out, *logs, "--licence", "Apache-2.0")
    dataset = read_dataset(out)
    whole = json.loads((out / "meta" / "stats.json").read_text())
    for values, found in (
        (dataset.columns(["action"])["action"], whole["action"]),
        (
            dataset.columns(["action"], episode=1)["action"],
            {key: dataset.episodes[1][f"stats/action/{key}"] for key in QUANTILES},
        ),
    ):
        for key, share in QUANTILES.items():
            np.testing.assert_allclose(found[key], np.quantile(values, share, axis=0), atol=1e-6)


def test_statistics_of_films_together() -> None:
    rng = np.random.default_rng(0)
    parts = [rng.uniform(size=(n, 3)) for n in (50, 150)]
    found, whole = together([statistics(part) for part in parts]), statistics(np.concatenate(parts))
    for key in ("min", "max", "mean", "std", "count"):
        np.testing.assert_allclose(found[key], whole[key])
    each = [statistics(part) for part in parts]
    np.testing.assert_array_equal(found["q10"], np.minimum(each[0]["q10"], each[1]["q10"]))
    np.testing.assert_array_equal(found["q90"], np.maximum(each[0]["q90"], each[1]["q90"]))


@pytest.mark.slow
def test_a_film_is_a_camera(logs: list[Path], tmp_path: Path) -> None:
    av = pytest.importorskip("av")
    out = tmp_path / "runs"
    words = [*map(str, logs), "--licence", "Apache-2.0", "--film", "--film-size", "160x120"]
    apart = [
        sys.executable,
        "-m",
        "servoid.tools.cli",
        "dataset",
        "add",
        str(out),
        *words,
    ]  # MuJoCo draws as it began to
    subprocess.run(apart, check=True)
    dataset = read_dataset(out)
    assert dataset.cameras == ["observation.images.film"]
    feature = dataset.features["observation.images.film"]
    assert (feature["shape"], feature["info"]["video.fps"]) == ([120, 160, 3], 50)
    for row in dataset.episodes:
        path = out / dataset.info["video_path"].format(
            video_key="observation.images.film",
            chunk_index=row["videos/observation.images.film/chunk_index"],
            file_index=row["videos/observation.images.film/file_index"],
        )
        with av.open(str(path)) as film:
            pictures = [frame.to_ndarray(format="rgb24") for frame in film.decode(video=0)]
            assert film.streams.video[0].average_rate == 50
        assert len(pictures) == row["length"]
        mean = np.asarray(row["stats/observation.images.film/mean"])
        assert mean.shape == (3, 1, 1)
        np.testing.assert_allclose(mean.ravel(), np.mean(pictures, (0, 1, 2)) / 255, atol=0.03)
    assert "observation.images.film" not in pq.read_table(dataset.files[0]).column_names
    assert read_recording(out, load_robot()).episode[-1] == 1


def test_what_does_not_belong_is_refused(logs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "runs"
    assert "--licence: missing" in refused(capsys, "add", out, logs[0])
    assert "not a flight log" in refused(capsys, "add", out, __file__, "--licence", "x")
    added(out, logs[0], "--licence", "x")
    capsys.readouterr()
    assert "it has no 'observation.images.film'" in refused(capsys, "add", out, logs[1], "--film")
    schema = Schema("op3", 100, {"x": Feature(("a",))}, ("t",))
    with pytest.raises(ConfigError, match="its rate is 50, and the new episodes' is 100"):
        DatasetWriter(out, schema, append=True)
    with pytest.raises(ConfigError, match="its robot is op3, and the new episodes' is wren"):
        DatasetWriter(out, Schema("wren", 50, {"x": Feature(("a",))}, ("t",)), append=True)
    assert sorted(path.name for path in tmp_path.iterdir() if not path.name.startswith(".")) == ["runs"]


def test_show(logs: list[Path], tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    out = tmp_path / "runs"
    added(out, *logs, "--licence", "x")
    capsys.readouterr()
    assert cli.main(["dataset", "show", str(out), "--column", "command"]) == 0
    said = capsys.readouterr().out
    assert "2 episodes" in said
    assert "forward" in said
    assert cli.main(["dataset", "show", str(out), "--episode", "1", "--json"]) == 0
    shown = json.loads(capsys.readouterr().out)
    assert (shown["episodes"], shown["tasks"]) == (1, {"walk": 1})
    assert "q50" in shown["statistics"]["action"]
    assert "no meta/info.json" in refused(capsys, "show", tmp_path)
    assert "did you mean 'action'" in refused(capsys, "show", out, "--column", "actoin")
    assert "episodes 0 to 1" in refused(capsys, "show", out, "--episode", "2")
    info = json.loads((out / "meta" / "info.json").read_text())
    (out / "meta" / "info.json").write_text(json.dumps(info | {"codebase_version": "v2.1"}))
    assert "of format v2.1" in refused(capsys, "show", out)

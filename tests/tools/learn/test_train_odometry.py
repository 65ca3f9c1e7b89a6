"""Learning the odometry's correction: what is recorded, and that fitting takes the error out."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.policy.checkpoint import CheckpointError, read, read_header
from servoid.stack.estimation.odometry import OFFSETS, OdometryFeatures, load_odometry
from servoid.tools.learn.settings import OdometryTraining
from servoid.tools.learn.trainers import odometry
from servoid.tools.learn.trainers.odometry import OdometryTrainer, walked
from servoid.tools.learn.walks import drift, maker, record

ROBOT = load_robot()


@pytest.fixture(scope="module")
def recorded() -> dict[str, np.ndarray]:
    return record(ROBOT, maker(ROBOT, "gait"), 6, 4.0, seed=0)


def test_a_recording_is_what_the_network_will_see(recorded: dict[str, np.ndarray]) -> None:
    size = OdometryFeatures(ROBOT).size
    assert recorded["rows"].shape == (6, 200, size)
    assert np.isfinite(recorded["rows"]).all()
    assert 0.02 < np.abs(recorded["errors"]).mean() < 0.5
    # A row looks back to the start of its own episode, never into the one before a fall.
    starts = recorded["starts"]
    assert (starts <= np.arange(200)).all()
    assert (np.diff(starts, axis=1) >= 0).all()
    changed = np.argwhere(np.diff(starts, axis=1) > 0)
    assert len(changed)  # 10 % noise and pushes: some gait falls
    for world, tick in changed:
        assert starts[world, tick + 1] == tick + 1


def trainer(data: dict[str, np.ndarray], out: Path, **changes: Any) -> OdometryTrainer:
    settings = OdometryTraining(**{"steps": 25, "worlds": 6, "seconds": 4.0, **changes})
    return OdometryTrainer(ROBOT, ["gait"], lambda: data, settings, out, "made up")


@pytest.fixture
def slipping(recorded: dict[str, np.ndarray]) -> Iterator[dict[str, np.ndarray]]:
    """Walks whose legs slip by a rule that can be learned."""
    threads = torch.get_num_threads()
    yield {**recorded, "errors": 0.3 * recorded["rows"][..., :3] + np.float32(0.1)}
    torch.set_num_threads(threads)


@pytest.mark.slow
def test_half_of_the_walks_are_on_a_floor_on_which_legs_are_off_by_more() -> None:
    """With all of them there, the odometry forgot how feet slip on the robot's own floor."""
    make, slippery = maker(ROBOT, "gait"), replace(ROBOT, floor_friction=0.2 * ROBOT.floor_friction)
    parts = [record(robot, make, 4, 3.0, 0, load_odometry(ROBOT)) for robot in (ROBOT, slippery)]
    errors = [float(np.sqrt(np.square(part["errors"]).mean())) for part in parts]
    assert errors[1] > 1.2 * errors[0]
    settings = OdometryTraining(policy=("gait",), worlds=8, seconds=3.0, floor=0.2)
    walks = walked(ROBOT, {"gait": make}, settings)
    assert len(walks["rows"]) == 8
    assert sum(any(np.array_equal(row, own) for own in parts[0]["rows"]) for row in walks["rows"]) == 4


def test_fitting_takes_a_systematic_slip_out(slipping: dict[str, np.ndarray], tmp_path: Path) -> None:
    trainer(slipping, tmp_path / "o.safetensors").run()
    network = load_odometry(ROBOT, tmp_path / "o.safetensors")
    ticks = np.arange(30, 200, 10)
    windows = slipping["rows"][:, ticks[:, None] - OFFSETS].reshape(6, len(ticks), -1)
    slip = slipping["errors"][:, ticks]
    assert np.square(slip - network(windows)).mean() < 0.25 * np.square(slip).mean()
    results = read_header(tmp_path / "o.safetensors")["results"]
    assert results["slow_rms"] < 0.5 * results["slow_rms_legs_alone"]
    # Its run is beside it.
    assert {"resume.pt", "log.csv", "learning_curve.png", "settings.yaml"} <= {
        p.name for p in (tmp_path / "o").iterdir()
    }


def test_what_to_do_next_is_no_copy_onto_itself(slipping: dict[str, np.ndarray], tmp_path: Path) -> None:
    """A robot's own odometry, written where the robot finds it, was to be copied there again."""
    made = trainer(slipping, tmp_path / "mine.safetensors")
    assert f"cp {tmp_path}/mine.safetensors" in made.following
    made.robot = replace(ROBOT, name="mine", folder=str(tmp_path / "mine"))
    made.best_path = tmp_path / "mine" / "odometry.safetensors"
    (tmp_path / "mine.yaml").touch()
    assert made.following == f"servoid rollout walk --policy gait --robot {tmp_path}/mine.yaml --episodes 10"


@pytest.mark.slow
def test_a_fit_that_was_interrupted_ends_as_one_that_was_not(slipping: dict[str, np.ndarray], tmp_path: Path) -> None:
    whole, parted = tmp_path / "whole", tmp_path / "parted"
    trainer(slipping, whole).run()
    first = trainer(slipping, parted)
    learn = first.learn

    def interrupted() -> dict[str, float]:
        if first.step == 10:
            raise KeyboardInterrupt
        return learn()

    first.learn = interrupted  # type: ignore[method-assign]
    with pytest.raises(KeyboardInterrupt):
        first.run()
    again = trainer(slipping, parted)
    again.start(resume=True)
    assert again.step == 10
    again.run()
    ours, theirs = (read(folder / "odometry.safetensors")[1] for folder in (parted, whole))
    for name, value in theirs.items():
        np.testing.assert_array_equal(ours[name], value)


def test_an_odometry_is_measured_and_nothing_is_trained(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parser = argparse.ArgumentParser()
    odometry.add_arguments(parser)
    out = tmp_path / "o.safetensors"
    options = ["--policy", "--out", str(out), "--walks", "2", "--walk-seconds", "1"]
    assert odometry.main(parser.parse_args([*options, "--measure"])) == 0
    said = capsys.readouterr()
    assert "gait, corrected: 2 walks of 1 s ..." in said.err
    assert "gait, legs alone: no walk of 1 s stayed up and went anywhere" in said.out
    assert not list(tmp_path.iterdir())
    with pytest.raises(ConfigError, match="--measure trains nothing, so --steps, --worlds would be ignored"):
        odometry.main(parser.parse_args(["--policy", "--measure", "--worlds", "3", "--steps", "3"]))
    with pytest.raises(CheckpointError, match="no such checkpoint"):
        odometry.main(parser.parse_args([*options, "--measure", str(tmp_path / "none.safetensors")]))


def test_walks_that_cover_no_metre_do_not_count() -> None:
    """Sway is no path: two seconds of walking sway a metre, and cover none."""
    result = drift(ROBOT, maker(ROBOT, "gait"), None, walks=4, seconds=2.0, seed=1)
    assert result.walks == 0
    assert np.isnan(result.p90)

"""Clips of datasets and logs are the motions that were recorded, and what is of another robot is refused."""

from __future__ import annotations

import json
from collections.abc import Callable
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import load_robot
from servoid.policy.motion.library import Library
from servoid.stack.log.flightlog import read_log
from servoid.stack.runtime.run import RunSettings, run
from servoid.tools.cli import main
from servoid.tools.learn.dataset.lerobot import DatasetWriter
from servoid.tools.learn.dataset.schema import Feature, Schema

ROBOT = load_robot()
TOLD = ("--name", "walk", "--caption", "walk", "--licence", "Apache-2.0", "--replace")
Import = Callable[..., str]


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> Path:
    path = tmp_path_factory.mktemp("log") / "walk.mcap"
    run(RunSettings(task="walk", policy="gait", seconds=2.0, record=path))
    return path


@pytest.fixture
def imported(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> Import:
    """Imports; returns the error, or nothing."""

    def call(*words: object) -> str:
        main(["motions", "import", *map(str, (*words, *TOLD, "--out", tmp_path / "clips")), "--json"])
        return str(json.loads(capsys.readouterr().out.splitlines()[-1]).get("error", ""))

    return call


def written(folder: Path, columns: dict[str, Array], names: dict[str, tuple[str, ...]], **schema: Any) -> Path:
    kept = {"robot_type": ROBOT.name, "fps": ROBOT.rate, "tasks": ("walk",), **schema}
    with DatasetWriter(folder, Schema(features={name: Feature(names[name]) for name in columns}, **kept)) as writer:
        writer.add(columns, np.zeros(len(next(iter(columns.values()))), int))
        writer.finish()
    return folder


def test_a_dataset_of_a_log_gives_the_clip_of_that_log(log: Path, tmp_path: Path, imported: Import) -> None:
    assert imported(log) == ""
    of_log = Library(ROBOT, tmp_path / "clips")["walk"]
    main(["dataset", "add", str(tmp_path / "runs"), str(log), "--licence", "Apache-2.0"])
    assert imported(tmp_path / "runs") == ""
    clip = Library(ROBOT, tmp_path / "clips")["walk"]
    assert clip.about.source == "dataset runs, episode 0"
    np.testing.assert_allclose(clip.joints, of_log.joints, atol=1e-6)
    np.testing.assert_allclose(clip.root_position, of_log.root_position, atol=1e-5)
    same = np.abs((clip.root_orientation * of_log.root_orientation).sum(-1))
    np.testing.assert_allclose(same, 1.0, atol=1e-5)
    np.testing.assert_allclose(clip.contact, of_log.contact, atol=0.1)  # the dataset does not say: by the soles


def test_joints_alone_are_played_in_physics_in_whatever_order_they_come(tmp_path: Path, imported: Import) -> None:
    """As datasets of LeRobot's own robots are: no motion of the base, and `.pos` behind each name."""
    goals = np.tile(ROBOT.home, (60, 1))
    goals[:, 0] += 0.3 * np.sin(np.linspace(0.0, np.pi, 60))
    names = tuple(f"{name}.pos" for name in reversed(ROBOT.names))
    assert imported(written(tmp_path / "nod", {"action": goals[:, ::-1]}, {"action": names})) == ""
    clip = Library(ROBOT, tmp_path / "clips")["walk"]
    assert clip.joints[:, 0].max() == pytest.approx(ROBOT.home[0] + 0.3, abs=0.02)
    assert clip.root_position[:, 2].min() > 0.9 * ROBOT.standing_height
    assert clip.contact.mean() > 0.9


def test_what_does_not_fit_is_refused(log: Path, tmp_path: Path, imported: Import) -> None:
    names, goals = {"action": tuple(ROBOT.names), "x": ("a",)}, np.tile(ROBOT.home, (60, 1))
    arm = written(tmp_path / "arm", {"action": np.zeros((60, 1))}, {"action": ("gripper.pos",)}, robot_type="so101")
    assert "is of robot 'so101', not of op3: its 'action' has no head_pan" in imported(arm)
    other = written(tmp_path / "other", {"action": goals}, names, robot_type="wren")
    assert "is of robot 'wren', not of op3" in imported(other)
    slow = written(tmp_path / "slow", {"action": goals}, names, fps=30)
    assert "has 30 frames a second, and op3 runs at 50" in imported(slow)
    lacking = written(tmp_path / "lacking", {"x": np.zeros((60, 1))}, names)
    assert "no column 'action'; it has x" in imported(lacking)
    far = written(tmp_path / "far", {"action": goals + 60.0 * (np.arange(20) == 3)}, names)  # degrees, say
    assert "beyond the joint ranges of op3: l_sho_roll by" in imported(far)
    good = written(tmp_path / "good", {"action": goals}, names)
    assert "no episode 7; choose one with --episode: 0 to 0" in imported(good, "--episode", 7)
    assert "has none: drop it" in imported(good, "--page", 3)
    assert "no meta/info.json" in imported(tmp_path)
    assert "is of another robot than wren" in imported(log, "--robot", "wren")
    assert read_log(log).complete

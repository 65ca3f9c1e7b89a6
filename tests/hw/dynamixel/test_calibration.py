"""What is kept of one assembled rig, and what is refused of it."""

from __future__ import annotations

import math
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.dynamixel.calibration import (
    Calibration,
    JointCalibration,
    apply,
    calibrated,
    calibration_path,
    load_calibration,
    save_calibration,
)
from servoid.hw.dynamixel.protocol.tables import table
from servoid.hw.dynamixel.protocol.units import Units
from servoid.hw.robot.description import load_robot
from servoid.stack.runtime.run import RunSettings, run

ROBOT = load_robot()


def measured(**changes: JointCalibration) -> Calibration:
    """A calibration in which every joint is turned round and off by its number in hundredths."""
    joints = {
        joint.name: JointCalibration(joint.id, "xm430-w350", -joint.direction, round(0.01 * i, 2))
        for i, joint in enumerate(ROBOT.joints)
    }
    return Calibration("op3", "2026-05-01T10:00:00+00:00", "zero", joints | changes)


@pytest.fixture(autouse=True)
def folder(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    return tmp_path


def test_it_is_read_back_as_written_and_changes_what_ticks_mean(folder: Path) -> None:
    path = calibration_path(ROBOT)
    assert path == folder / "servoid" / "calibration" / "op3.yaml"
    assert save_calibration(measured(), path) is None
    assert load_calibration(path) == measured()
    robot, line = calibrated(ROBOT)
    assert "calibrated on 2026-05-01" in line
    assert str(path) in line
    ticks = np.full(20, 2048 + 100)
    angle = Units(robot, [table("xm430-w350")] * 20).position(ticks)
    np.testing.assert_allclose(angle, 0.01 * np.arange(20) - 100 * math.tau / 4096)
    assert replace(robot, joints=ROBOT.joints) == ROBOT, "nothing else is touched"


def test_without_one_the_file_counts_and_the_line_says_so() -> None:
    robot, line = calibrated(ROBOT)
    assert robot is ROBOT
    assert "not calibrated" in line


def test_an_earlier_one_is_never_lost(folder: Path) -> None:
    path = folder / "c.yaml"
    first, second, third = (replace(measured(), date=f"2026-05-0{i}T10:00:00+00:00") for i in (1, 2, 3))
    save_calibration(first, path)
    kept = [save_calibration(second, path), save_calibration(third, path)]
    assert [load_calibration(p) for p in kept if p] == [first, second]
    assert load_calibration(path) == third
    assert len(list(folder.iterdir())) == 3, "nothing half written is left"


def test_a_relative_configuration_folder_is_ignored(monkeypatch: pytest.MonkeyPatch, tmp_path: Path) -> None:
    """As the XDG specification says: or the calibration would depend on where a command was started."""
    monkeypatch.setenv("XDG_CONFIG_HOME", "here")
    monkeypatch.setenv("HOME", str(tmp_path))
    assert calibration_path(ROBOT) == tmp_path / ".config/servoid/calibration/op3.yaml"


def test_a_folder_that_cannot_be_written_is_named(folder: Path) -> None:
    (folder / "file").write_text("")
    with pytest.raises(ConfigError, match="XDG_CONFIG_HOME"):
        save_calibration(measured(), folder / "file" / "c.yaml")


@pytest.mark.parametrize(
    ("changes", "words"),
    [
        ({"l_knee": JointCalibration(15, "xm430-w350", 1, 0.0)}, "l_knee was xm430-w350 with ID 15 then"),
        ({"l_knee": JointCalibration(14, "xm540-w270", 1, 0.0)}, "l_knee was xm540-w270"),
        ({"l_kneee": JointCalibration(14, "xm430-w350", 1, 0.0)}, "no joint 'l_kneee'; did you mean 'l_knee'"),
        ({"l_knee": JointCalibration(14, "xm430-w350", 1, -2.0)}, "l_knee a part .* seam"),
        ({"r_knee": JointCalibration(13, "xm430-w350", -1, 2.0)}, "r_knee a part .* seam"),
    ],
)
def test_what_is_not_of_this_robot_or_cannot_be_driven_is_refused(
    changes: dict[str, JointCalibration], words: str
) -> None:
    with pytest.raises(ConfigError, match=words):
        apply(ROBOT, measured(**changes))


def test_a_joint_that_was_not_measured_is_named() -> None:
    joints = {name: joint for name, joint in measured().joints.items() if name != "l_el"}
    with pytest.raises(ConfigError, match=r"nothing about l_el: .*--joint l_el"):
        apply(ROBOT, replace(measured(), joints=joints))


def test_a_file_that_was_edited_wrongly_is_named_with_its_line() -> None:
    path = calibration_path(ROBOT)
    save_calibration(measured(), path)
    path.write_text(path.read_text().replace("direction: -1, zero: 0.03", "direction: 2, zero: 0.03"))
    with pytest.raises(ConfigError, match=r"op3\.yaml:8: joints\.l_sho_roll: direction must be 1 or -1, not 2"):
        calibrated(ROBOT)


def test_a_run_on_hardware_loads_it_and_one_in_simulation_does_not() -> None:
    """A damaged calibration stops the one, before any port is opened, and is nothing to the other."""
    path = calibration_path(ROBOT)
    path.parent.mkdir(parents=True)
    path.write_text("robot: op3\n")
    with pytest.raises(ConfigError, match=r"op3\.yaml"):
        run(RunSettings("stand", backend="dynamixel", policy="gait", port="/dev/null", start=True))
    assert run(RunSettings("stand", policy="gait", seconds=0.2)).ticks

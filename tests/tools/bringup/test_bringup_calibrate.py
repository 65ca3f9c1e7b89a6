"""`servoid bringup calibrate`: it finds how a rig was assembled, and refuses what a person got wrong."""

from __future__ import annotations

import io
import math
import sys
from collections.abc import Callable
from pathlib import Path
from typing import Any

import mujoco
import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array, BackendError
from servoid.hw.dynamixel.calibration import (
    Calibration,
    JointCalibration,
    calibrated,
    calibration_path,
    load_calibration,
    save_calibration,
)
from servoid.hw.robot.description import load_robot
from servoid.sim.model import build
from servoid.sim.rig.process.control import LockedClock, RigProcess
from servoid.sim.rig.servo.factory_state import FactoryState
from servoid.tools.bringup import calibrate
from servoid.tools.bringup.calibrate import MOVED, check_range, directions_of, turned
from servoid.tools.bringup.calibration.encoders import Encoders
from servoid.tools.bringup.calibration.hands import Person
from servoid.tools.bringup.calibration.turning import describe_turns
from servoid.tools.bringup.desk.terminal import Desk
from servoid.tools.common.output import Report

ROBOT = load_robot()
TICK = math.tau / 4096


def never(*_: Any, **__: Any) -> Any:
    raise AssertionError("the robot is measured")


@pytest.mark.slow
def test_it_finds_the_assembly_of_a_rig_on_a_serial_port_and_check_then_uses_it(
    bringup: Any, monkeypatch: pytest.MonkeyPatch
) -> None:
    """A rig whose horns sit off and whose servos are partly the other way round, as a person builds one."""
    factory_state = FactoryState(assembly="random")
    truth = factory_state.assembled(ROBOT, 5)
    with RigProcess(ROBOT, seed=5, factory_state=factory_state, linger=120.0) as rig:
        link = Path(str(rig.control_path)).with_name("rig")
        link.symlink_to(rig.port)
        link.with_name("rig.control").symlink_to(rig.control_path)
        # In the rig's time, so that a busy machine does not matter.
        monkeypatch.setattr("servoid.hw.clock.WallClock", lambda: LockedClock(rig.control))
        code, answer, err = bringup("calibrate", "--port", str(link), "--yes")
        assert code == 0, err
        found = calibrated(ROBOT)[0]
        assert answer["path"] == str(calibration_path(ROBOT))
        for joint, true in zip(found.joints, truth.joints, strict=True):
            assert joint.direction == true.direction, joint.name
            assert joint.zero == pytest.approx(true.zero, abs=3 * TICK), joint.name
        assert {joint.direction for joint in truth.joints} == {1, -1}, "a test of one direction would be none"
        assert "the other way round" in err

        code, answer, err = bringup("check", "--port", str(link), "--fix")
        assert code == 0, err
        assert "calibrated on 20" in err
        limits = {(d["joint"], d["register"]): d["wanted"] for d in answer["differences"]}
        head = found.joints[0]
        ends = sorted(2048 + head.direction * (end - head.zero) / TICK for end in head.range)
        assert limits["head_pan", "min_position_limit"] == math.floor(ends[0])
        assert limits["head_pan", "max_position_limit"] == math.ceil(ends[1])

        before = load_calibration(calibration_path(ROBOT)).joints
        code, answer, _ = bringup("calibrate", "--port", str(link), "--joint", "l_knee", "--pose", "home", "--yes")
        assert code == 0
        after = load_calibration(calibration_path(ROBOT)).joints
        assert {name for name in after if after[name] != before[name]} <= {"l_knee"}
        assert after["l_knee"].zero == pytest.approx(before["l_knee"].zero, abs=3 * TICK)

        code, answer, err = bringup("calibrate", "--port", str(link), "--keep-directions", "--yes")
        assert code == 0, err
        for joint, true in zip(calibrated(ROBOT)[0].joints, truth.joints, strict=True):
            assert joint.direction == true.direction, f"{joint.name} would be driven the wrong way"
            assert joint.zero == pytest.approx(true.zero, abs=3 * TICK), joint.name


@pytest.mark.parametrize("known", [None, "head_pan"])
def test_what_was_never_measured_is_not_written_down_as_measured(
    bringup: Any, configuration: Path, monkeypatch: pytest.MonkeyPatch, known: str | None
) -> None:
    """Of one joint alone, the others would be the robot file's, with a date and a pose that say otherwise."""
    monkeypatch.setattr(calibrate, "open_line", never)
    path = configuration / "op3.yaml"
    if known is not None:
        joint = ROBOT.joints[ROBOT.names.index(known)]
        one = JointCalibration(joint.id, "xm430-w350", 1, 0.0)
        save_calibration(Calibration("op3", "2026-01-01", "zero", {known: one}), path)
    words = ("--port", "/dev/ttyUSB0", "--out", str(path), "--joint", "l_knee")
    code, answer, _ = bringup("calibrate", *words)
    assert code == 2
    assert f"{path}: " in answer["error"]
    assert "calibrate all joints first, without --joint" in answer["error"]


def test_torque_and_registers_that_bend_angles_are_refused(rig: RigProcess, bringup: Any) -> None:
    from test_bringup_scan import write

    write(rig, 14, torque_enable=1)
    code, answer, _ = bringup("calibrate", "--port", "virtual")
    assert code == 3
    assert "l_knee has torque on" in answer["error"]
    write(rig, 14, torque_enable=0)
    write(rig, 14, drive_mode=1)
    code, answer, _ = bringup("calibrate", "--port", "virtual")
    assert code == 3
    assert "l_knee has a drive_mode that is not 0" in answer["error"]


def test_on_a_virtual_rig_of_its_own_nothing_is_kept(rig: RigProcess, bringup: Any, configuration: Path) -> None:
    """Or practising would replace the calibration of the real robot."""
    code, answer, err = bringup("calibrate", "--port", "virtual", "--keep-directions")
    assert code == 0, err
    assert answer["path"] is None
    assert not list(configuration.rglob("*.yaml"))
    assert all(abs(joint["zero"]) < 3 * TICK for joint in answer["joints"].values())


def test_mistakes_on_the_command_line(bringup: Any) -> None:
    code, answer, _ = bringup("calibrate", "--port", "virtual", "--joint", "l_kneee")
    assert (code, "did you mean 'l_knee'" in answer["error"]) == (2, True)


def test_a_file_that_cannot_be_written_is_refused_before_anybody_measures(
    bringup: Any, configuration: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Or twenty joints are turned by hand, and what was measured is lost."""
    monkeypatch.setattr(calibrate, "open_line", never)
    (configuration / "file").write_text("")
    out = configuration / "file" / "op3.yaml"
    code, answer, _ = bringup("calibrate", "--port", "virtual", "--out", str(out))
    assert code == 2
    assert f"{out}: cannot be written" in answer["error"]
    monkeypatch.setenv("XDG_CONFIG_HOME", str(configuration / "file"))
    code, answer, _ = bringup("calibrate", "--port", "/dev/ttyUSB0")
    assert code == 2
    assert "set XDG_CONFIG_HOME to your own folder" in answer["error"]


# What a person does --------------------------------------------------------------------------------------------------


class ByHand(Encoders):
    """Servo angles that a function of the sample's number gives."""

    def __init__(self, angles: Callable[[int], Array]) -> None:
        self.names, self._angles, self._count = ROBOT.names, angles, 0
        self._clock = self  # type: ignore[assignment]

    def now_ns(self) -> int:
        return self._count * 30_000_000

    def read(self) -> Array:
        self._count += 1
        return (self._angles(self._count) + np.pi) % (2 * np.pi) - np.pi


def moving(**rates: float) -> Callable[[int], Array]:
    """Joints that turn by so much in half a second and then hold, from just before the servo's seam."""
    by = np.array([rates.get(name, 0.0) for name in ROBOT.names])
    return lambda count: np.full(20, np.pi - 0.01) + by * min(count / 15, 1.0)


KNEE = ROBOT.names.index("l_knee")
START = np.full(20, np.pi - 0.01)


@pytest.mark.parametrize("by", [0.4, -0.4])
def test_a_turn_is_seen_across_the_seam_and_with_other_joints_hanging_loose(by: float) -> None:
    """0.01 rad before the 4095/0 seam: taken as it reads, the joint would have turned by almost a whole turn."""
    assert turned(ByHand(moving(l_knee=by, l_ank_pitch=0.5)), START, KNEE, ROBOT) == pytest.approx(by, abs=0.01)


def test_a_person_is_told_the_angles_of_a_pose_that_is_not_all_zero(
    monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """Nobody could put a robot into a pose of which the name is all that is said."""
    monkeypatch.setattr("sys.stdin", io.StringIO("\n\n"))
    hands = Person(Desk(Report(False, sys.stdout)))
    hands.pose(dict(zip(ROBOT.names, ROBOT.home.tolist(), strict=True)), "the home pose")
    rows = [line.split() for line in capsys.readouterr().out.splitlines()]
    assert rows[0] == ["joint", "rad", "degrees"]
    assert ["l_knee", "+0.852", "+49"] in rows
    hands.pose(dict.fromkeys(ROBOT.names, 0.0), "all at 0")
    assert capsys.readouterr().out == ""


class Hasty:
    """Hands that put a joint straight back, less some play, and hold it there only when they are asked again."""

    def __init__(self) -> None:
        self.asked: list[str] = []
        self._count = 0

    def pose(self, angles: Any, text: str) -> None: ...

    def turn(self, joint: str, sign: int, text: str) -> None:
        self.asked.append(text)
        self._count = 0

    def back(self, joint: str) -> None: ...

    def angles(self, count: int) -> Array:
        self._count += 1
        straight_back = 0.3 if self._count < 5 else -0.01
        return np.eye(20)[KNEE] * (0.0, straight_back, 0.3)[len(self.asked)]


def test_a_joint_that_is_put_straight_back_is_asked_for_again() -> None:
    """Its angle at rest is noise, and so would its direction be: the joint would then be driven the wrong way."""
    hands = Hasty()
    assert directions_of(ByHand(hands.angles), hands, ROBOT, np.zeros(20), [KNEE]) == {KNEE: 1}
    assert len(hands.asked) == 2
    assert "it did not stay there: turn l_knee again" in hands.asked[1]


def test_another_joint_than_asked_is_named_with_both_ids() -> None:
    with pytest.raises(BackendError, match=r"r_knee \(ID 13\) turned, not l_knee \(ID 14\)") as error:
        turned(ByHand(moving(r_knee=0.5)), START, KNEE, ROBOT)
    assert "servoid bringup setup" in str(error.value)


def test_a_joint_that_nobody_turns_is_an_error_and_not_a_wait_for_ever() -> None:
    with pytest.raises(BackendError, match="l_knee was not turned within"):
        turned(ByHand(moving(l_knee=MOVED / 2)), START, KNEE, ROBOT)


def test_a_pose_that_is_not_held_still_is_refused_by_name() -> None:
    swinging = ByHand(lambda count: np.eye(20)[KNEE] * 0.1 * math.sin(count))
    with pytest.raises(BackendError, match=r"l_knee still moves by 0\.2"):
        swinging.still(2.0)


def test_a_joint_beyond_its_range_is_refused_by_name() -> None:
    end = float(ROBOT.upper[KNEE])
    check_range(ROBOT, KNEE, end)
    with pytest.raises(BackendError, match=rf"l_knee would be at {end + 0.3:.2f} rad now, beyond its range"):
        check_range(ROBOT, KNEE, end + 0.3)


def test_the_reference_pose_must_be_within_every_range() -> None:
    from dataclasses import replace

    from servoid.tools.bringup.calibrate import _reference

    bent = replace(ROBOT, joints=(replace(ROBOT.joints[0], range=(0.2, 1.0)), *ROBOT.joints[1:]))
    with pytest.raises(ConfigError, match="head_pan cannot be at 0: use --pose home"):
        _reference("zero", bent)


def test_the_words_for_a_turn_are_what_physics_does() -> None:
    """A person who turns a knee the wrong way because the text is wrong calibrates a robot that kicks."""
    model = build(ROBOT)
    data = mujoco.MjData(model)
    words = {"forward": (0, 1), "backward": (0, -1), "left": (1, 1), "right": (1, -1), "up": (2, 1), "down": (2, -1)}
    texts = describe_turns(ROBOT, np.zeros(20), np.ones(20))
    said = 0
    for name, text in zip(ROBOT.names, texts, strict=True):
        if not text.startswith("what it carries goes "):
            continue
        said += 1
        body = model.joint(name).bodyid[0]
        places = []
        for angle in (0.0, 0.05):
            data.qpos[:] = model.qpos0
            data.joint(name).qpos = angle
            mujoco.mj_forward(model, data)
            places.append(data.subtree_com[body] - data.body(ROBOT.base).xpos)
        axis, sign = words[text.split()[4]]
        moved = places[1] - places[0]
        assert int(np.abs(moved).argmax()) == axis, text
        assert np.sign(moved[axis]) == sign, text
    assert said >= 12

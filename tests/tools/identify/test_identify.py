"""Identification of servos on the gantry: recordings, fits, and what a person sees of both."""

from __future__ import annotations

import json
import re
import signal
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Observation, Sensors
from servoid.hw.robot.description import Robot, load_robot, load_servo, save_servo
from servoid.sim.joints.friction import Friction
from servoid.sim.rig.in_process import InProcessBackend
from servoid.sim.rig.rig import Rig
from servoid.stack.log.flightlog import read_log
from servoid.tools.bench.identify import record_rig
from servoid.tools.cli import main
from servoid.tools.identify.excitation import HELD_OUT, middle_pose, plan
from servoid.tools.identify.fit import identify
from servoid.tools.identify.recording import read_pieces
from servoid.tools.identify.rehearsal import _delayed
from servoid.tools.identify.session import record

OP3 = load_robot()


def described(folder: Path) -> Robot:
    """The robot of four joints that the documentation describes."""
    page = (Path(__file__).parents[3] / "docs/own-robot.md").read_text()
    (folder / "stilts.yaml").write_text(re.findall(r"```yaml\n(.*?)```", page, re.DOTALL)[0])
    (folder / "stilts.xml").write_text(re.findall(r"```xml\n(.*?)```", page, re.DOTALL)[0])
    return load_robot(folder / "stilts.yaml")


@pytest.fixture
def stilts(tmp_path: Path) -> Robot:
    return described(tmp_path)


def with_servo(robot: Robot, folder: Path, **figures: float) -> Robot:
    """The robot with another servo at every joint."""
    save_servo(replace(load_servo("xm430-w350"), **figures), folder / "hidden.yaml")
    return replace(robot, joints=tuple(replace(joint, servo=str(folder / "hidden.yaml")) for joint in robot.joints))


def test_motions_stay_in_reach_and_begin_and_end_in_the_middle() -> None:
    for motion in plan(OP3, [OP3.names], 0.3):
        assert (motion.goals >= OP3.lower + OP3.limits.margin - 1e-9).all()
        assert (motion.goals <= OP3.upper - OP3.limits.margin + 1e-9).all()
        assert np.allclose(motion.goals[[0, -1]], middle_pose(OP3))
        fastest = np.abs(np.diff(motion.goals, axis=0)).max() * OP3.rate
        assert motion.name == "steps" or fastest <= OP3.limits.joint_speed


def test_one_by_one_only_one_joint_moves() -> None:
    motions = plan(OP3, [["l_knee"], ["r_el"]])
    moved = [np.flatnonzero(np.ptp(motion.goals, axis=0) > 0).tolist() for motion in motions]
    assert moved == [[OP3.names.index("l_knee")]] * 4 + [[OP3.names.index("r_el")]] * 4


def test_a_joint_without_room_is_named() -> None:
    joints = tuple(replace(j, range=(j.home - 0.04, j.range[1])) if j.name == "l_knee" else j for j in OP3.joints)
    with pytest.raises(ConfigError, match=r"l_knee: less than 0\.05 rad of room"):
        plan(replace(OP3, joints=joints), [OP3.names])


def test_limbs_that_touch_however_little_they_move_are_named(tmp_path: Path, stilts: Robot) -> None:
    """Two soles side by side with 2 mm between them: a roll of any size would press one against the other."""
    xml = Path(stilts.mjcf).read_text().replace('axis="0 1 0"', 'axis="1 0 0"').replace('axis="0 -1 0"', 'axis="1 0 0"')
    xml = xml.replace('size="0.06 0.03 0.01"', 'size="0.06 0.0499999 0.01"')
    (tmp_path / "close.xml").write_text(xml)
    close = replace(stilts, mjcf=str(tmp_path / "close.xml"))
    with pytest.raises(ConfigError, match="l_shank and r_shank would touch"):
        plan(close, [["l_hip"]])


def test_a_delay_of_part_of_a_step_lets_the_old_goal_act_for_that_part() -> None:
    goal = np.array([0.0, 1.0, 1.0, 1.0])[None, :, None]
    acting = _delayed(goal, np.array([[0.010]]), 0.020, 5)[0, :, 0]
    assert acting.tolist() == pytest.approx([0] * 5 + [0, 0, 0.5] + [1] * 12)


def test_friction_rises_towards_rest_and_with_the_load(tmp_path: Path, stilts: Robot) -> None:
    robot = with_servo(stilts, tmp_path, friction=0.1, stribeck_friction=0.05, stribeck_speed=0.2, load_friction=0.1)
    law = Friction(robot)
    assert law.varies
    assert not Friction(stilts).varies
    found = law.at(np.array([0.0, 0.2, -10.0, 0.0]), np.array([0.0, 0.0, 0.0, -2.0]))
    assert found.tolist() == pytest.approx([0.15, 0.1 + 0.05 / np.e, 0.1, 0.35])


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Robot, list[Path]]:
    """The stilts, and the logs of a rig with other servos than their file says."""
    folder = tmp_path_factory.mktemp("rig")
    robot = described(folder)
    rig = with_servo(
        robot, folder, stiffness=13.0, friction=0.15, armature=0.004, command_delay=0.028, load_friction=0.1
    )
    return robot, record_rig(robot, rig, folder)


@pytest.mark.slow
def test_hidden_servos_are_found_from_motions_alone(recorded: tuple[Robot, list[Path]]) -> None:
    robot, logs = recorded
    pieces = read_pieces(logs, robot)
    assert len(pieces) == 8
    best, _ = identify(robot, pieces, lambda text: None, ("coulomb", "load"))
    assert best.model == "load"
    servo = best.servos["xm430-w350"]
    assert servo.stiffness == pytest.approx(13.0, rel=0.05)
    assert servo.friction == pytest.approx(0.15, rel=0.05)
    assert servo.command_delay == pytest.approx(0.028, rel=0.05)
    assert np.degrees(best.held_out) < 0.1
    known = {found.figure.name: found.determined for found in best.found}
    assert known["stiffness"]
    assert known["command_delay"]


@pytest.mark.slow
def test_a_hot_servo_ends_the_recording_and_loses_nothing(tmp_path: Path, stilts: Robot) -> None:
    motions = plan(stilts, [stilts.names])
    body = InProcessBackend(Rig(stilts))
    body.rig.auto_release = False
    handles = body.connect()
    body.inject("heat", servo="l_knee", value=75.0)  # the slow registers are read before anything moves
    log = tmp_path / "hot.mcap"
    recorded = record(body, handles, stilts, motions, 1.0, log)
    assert recorded.cause == "temperature"
    assert "l_knee is at 7" in recorded.texts[0]
    assert not any(state["torque"] for state in body.rig.servo_states())
    with pytest.raises(ConfigError, match="no motion was recorded to its end"):
        read_pieces([log], stilts)


@pytest.mark.slow
def test_a_log_that_was_cut_off_has_its_whole_motions(recorded: tuple[Robot, list[Path]], tmp_path: Path) -> None:
    """A kill leaves a file that ends anywhere."""
    robot, (whole, *_) = recorded
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(whole.read_bytes()[: whole.stat().st_size // 2])
    names = [piece.name for piece in read_pieces([cut], robot)]
    assert names[:2] == ["steps", "ramps"]
    assert HELD_OUT not in names


@pytest.mark.slow
def test_on_a_virtual_rig_the_command_writes_servo_files_that_load(
    tmp_path: Path, stilts: Robot, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    words = ["--port", "virtual", "--friction", "coulomb", "--load", "l_shank=0.1@0,0,-0.1", "--json"]
    code = main(["identify", "--robot", "stilts.yaml", *words])
    out, err = capfd.readouterr()
    assert code == 0, err
    result = json.loads(out)
    servo = load_servo(str(tmp_path / result["files"][0]))
    assert servo.stiffness == pytest.approx(9.4, rel=0.05)
    assert servo.command_delay == pytest.approx(0.020, rel=0.05)
    assert "On l_shank hang 0.1 kg." in err
    assert "not determined" in err
    assert [Path(file).is_file() for file in result["files"]] == [True] * len(result["files"])
    # The log knows of the weight.
    (piece, *_) = read_pieces([Path(result["logs"][0])], stilts)
    assert piece.robot.loads["l_shank"].mass == 0.1


@pytest.mark.parametrize(
    ("words", "text"),
    [
        (["--port", "virtual", "--amplitude", "30"], "--amplitude 30: must be between 0.05 and 0.6 rad"),
        (["--port", "virtual", "--joints", "l_kneee"], "op3 has no joint 'l_kneee'; did you mean 'l_knee'?"),
        (["--port", "virtual", "--load", "l_knee_link"], "--load l_knee_link: write BODY=KG"),
        (["--port", "virtual", "--load", "l_knee_link=-1"], "a weight must be between 0 and 100 kg"),
        (["--port", "virtual", "--load", "l_kne_link=1"], "no body (that carries a load) named 'l_kne_link'"),
        (["--port", "virtual", "--from", "a.mcap"], "--from fits what was recorded, and --port is for recording"),
        (["--from", "nowhere.mcap"], "nowhere.mcap: cannot be read"),
        (["--from", "nowhere.mcap", "--out", "/dev/null/x"], "cannot be written (Not a directory)"),
        ([], "port missing"),
    ],
)
def test_bad_input_is_one_line(
    words: list[str], text: str, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.chdir(tmp_path)
    assert main(["identify", *words]) == 2
    err = capfd.readouterr().err
    assert text in err
    assert "internal error" not in err


def test_a_log_of_something_else_and_of_another_robot_is_refused(tmp_path: Path, stilts: Robot) -> None:
    from servoid.stack.runtime.run import RunSettings, run

    run(RunSettings("stand", policy="gait", seconds=0.2, record=tmp_path / "stand.mcap"))
    with pytest.raises(ConfigError, match=r"stand.mcap: a log of stand: servoid identify records what it needs"):
        read_pieces([tmp_path / "stand.mcap"], stilts)


@dataclass
class PressedLater:
    """A body's sensors, at one of whose readings a person presses Ctrl-C."""

    sensors: Sensors
    at: int
    count: int = 0

    def read(self) -> Observation:
        self.count += 1
        if self.count == self.at:
            signal.raise_signal(signal.SIGINT)
        return self.sensors.read()


@pytest.mark.slow
def test_ctrl_c_in_the_middle_leaves_the_robot_off_and_keeps_whole_motions(tmp_path: Path, stilts: Robot) -> None:
    motions = plan(stilts, [stilts.names])
    body = InProcessBackend(Rig(stilts))
    body.rig.auto_release = False
    sensors, motors = body.connect()
    at = round(3.0 * stilts.rate) + len(motions[0].goals) + len(motions[1].goals) // 2  # in the second motion
    log = tmp_path / "cut.mcap"
    recorded = record(body, (PressedLater(sensors, at), motors), stilts, motions, 1.0, log)
    assert recorded.cause == "interrupt"
    assert any("interrupted" in text for text in recorded.texts)
    assert not any(state["torque"] for state in body.rig.servo_states())
    names = [piece.name for piece in read_pieces([log], stilts)]
    assert names[0] == motions[0].name
    assert motions[2].name not in names


@pytest.mark.slow
def test_a_joint_that_meets_its_stop_ends_the_recording_and_is_named(tmp_path: Path, stilts: Robot) -> None:
    """A file that gives a knee more room than the robot has: the motor would push against metal for a minute."""
    stop = '<geom type="box" size="0.02 0.02 0.05" pos="-0.04 0.05 -0.25"/><site name="imu"'
    text = Path(stilts.mjcf).read_text().replace('<site name="imu"', stop)
    (tmp_path / "stopped.xml").write_text(text)
    body = InProcessBackend(Rig(replace(stilts, mjcf=str(tmp_path / "stopped.xml"))))
    body.rig.auto_release = False
    log = tmp_path / "stopped.mcap"
    recorded = record(body, body.connect(), stilts, plan(stilts, [stilts.names]), 1.0, log)
    assert recorded.cause == "overload", recorded.texts
    assert re.search(
        r"l_(hip|knee) stands still 0\.\d+ rad short of where it was sent: is it at a stop", recorded.texts[-1]
    )
    assert not any(state["torque"] for state in body.rig.servo_states())
    assert read_log(log).complete

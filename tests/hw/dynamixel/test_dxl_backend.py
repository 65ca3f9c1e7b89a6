"""The backend on a scripted bus: what it refuses, that it never moves on its own, and how torque comes and goes."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from scripted import Memory
from scripted_op3 import ROBOT, Robot, active, run

from servoid.hw.config import CONFIGS
from servoid.hw.contracts.body import BackendError, Command, Mode
from servoid.hw.dynamixel.backend import DynamixelBackend
from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.codec import InstructionCode
from servoid.hw.dynamixel.servos.register_check import as_table


@pytest.fixture
def robot() -> Robot:
    return Robot()


# Connecting ----------------------------------------------------------------------------------------------------------


def test_connecting_powers_reads_and_moves_nothing(robot: Robot) -> None:
    sensors, _ = robot.backend().connect()
    assert robot.board.get("dynamixel_power") == 1
    assert robot.moved() == []
    o = sensors.read()
    np.testing.assert_allclose(o.position, ROBOT.home, atol=0.001)
    assert (o.velocity == 0).all()
    assert (o.effort == 0).all()
    assert (o.age < 0.02).all()
    assert (o.fault == 0).all()
    assert np.isnan(o.orientation).all()
    np.testing.assert_allclose(o.specific_force, [0, 0, 9.81], atol=0.05)
    assert robot.moved() == []


def test_servos_that_start_slowly_are_waited_for(robot: Robot) -> None:
    for servo in robot.servos:
        servo.answers = False
    on = robot.line.time + 400_000_000

    def boot(packet: codec.Packet) -> None:
        if robot.line.time > on:
            for servo in robot.servos:
                servo.answers = True

    robot.line.before_answer = boot
    robot.backend().connect()


def refusal(robot: Robot) -> str:
    with pytest.raises(BackendError) as error:
        robot.backend().connect()
    assert robot.moved() == []
    assert robot.line.gone, "a port that is of no use is given back"
    return str(error.value)


def test_a_missing_servo_is_named(robot: Robot) -> None:
    robot.joint("l_knee").answers = False
    robot.joint("r_el").answers = False
    assert "no answer from r_el (ID 5), l_knee (ID 14)" in refusal(robot)


def test_a_missing_board_is_named(robot: Robot) -> None:
    robot.board.answers = False
    assert "the board (ID 200) does not answer at 2000000" in refusal(robot)


def test_a_wrong_model_is_refused(robot: Robot) -> None:
    robot.joint("head_pan").put("model_number", 1060)
    assert "head_pan (ID 19) is a xl430-w250, but the robot's file says xm430-w350" in refusal(robot)


def test_two_servos_with_an_id_are_suspected(robot: Robot) -> None:
    robot.line.fault = lambda id, data: [(data[:-3] + b"\x55\xaa\x55", 0)] if id == 14 else [(data, 0)]
    message = refusal(robot)
    assert "l_knee" in message
    assert "two servos may have the same ID" in message


def test_a_wrong_voltage_is_refused(robot: Robot) -> None:
    robot.joint("l_el").put("present_input_voltage", 88)
    assert "l_el (ID 6) has 8.8 V, outside 9.5 to 16 V" in refusal(robot)


def test_differences_are_a_table_and_corrected_only_when_told_to(robot: Robot) -> None:
    robot.joint("l_hip_roll").put("operating_mode", 4)
    robot.joint("r_el").put("max_position_limit", 2100)
    robot.joint("l_el").put("return_delay_time", 250)
    with pytest.raises(BackendError, match=r"3 registers .* `servoid bringup check --fix`") as error:
        robot.backend().connect()
    (note,) = error.value.__notes__
    rows = [line.split() for line in note.splitlines()]
    limit = 2048 + int(np.ceil(ROBOT.joints[ROBOT.names.index("r_el")].range[1] / (2 * np.pi) * 4096))
    assert rows[0] == ["joint", "ID", "register", "found", "wanted"]
    assert ["l_hip_roll", "10", "operating_mode", "4", "3", "must", "be", "changed"] in rows
    assert ["r_el", "5", "max_position_limit", "2100", str(limit), "must", "be", "changed"] in rows
    assert ["l_el", "6", "return_delay_time", "250", "0"] in rows
    assert robot.joint("l_hip_roll").get("operating_mode") == 4
    robot.line.gone = False
    backend = robot.backend(fix=True)
    backend.connect()
    assert backend.differences == ()
    assert robot.joint("l_hip_roll").get("operating_mode") == 3
    assert robot.moved() == []


def test_small_differences_are_reported_and_not_refused(robot: Robot) -> None:
    robot.joint("l_el").put("temperature_limit", 75)
    backend = robot.backend()
    backend.connect()
    assert [(d.joint, d.register, d.found, d.wanted) for d in backend.differences] == [
        ("l_el", "temperature_limit", 75, 80)
    ]
    assert "l_el" in as_table(backend.differences)


def test_who_asks_for_a_robot_exactly_as_its_file_gets_no_other(robot: Robot) -> None:
    """What `servoid run` asks for: a servo that answers 0.5 ms late, or gets hotter than it should, is no small thing
    with torque on."""
    robot.joint("l_el").put("temperature_limit", 75)
    with pytest.raises(BackendError, match="1 registers differ from what op3 needs, the first on l_el"):
        robot.backend(exact=True).connect()
    assert robot.line.gone


def test_registers_are_not_corrected_under_torque(robot: Robot) -> None:
    robot.joint("l_el").put("return_delay_time", 250)
    robot.joint("l_el").put("torque_enable", 1)
    with pytest.raises(BackendError, match="l_el has torque on"):
        robot.backend(fix=True).connect()


def test_a_robot_may_mix_models(robot: Robot, tmp_path: Path) -> None:
    """A head of XL430: it moves like the others, has no effort, and firmware that knows no fast frames."""
    text = (CONFIGS / "servos" / "xm430-w350.yaml").read_text()
    for old, new in (
        ("1020", "1060"),
        ("name: xm430-w350", "name: xl430-w250"),
        ("max_temperature: 80", "max_temperature: 72"),
    ):
        text = text.replace(old, new)
    (tmp_path / "xl430-w250.yaml").write_text(text)
    joints = [
        replace(j, servo=str(tmp_path / "xl430-w250.yaml")) if j.name.startswith("head") else j for j in ROBOT.joints
    ]
    mixed = replace(ROBOT, joints=tuple(joints))
    for i in (0, 1):
        old, new = robot.servos[i], Memory("xl430-w250", joints[i].id)
        for name in ("return_delay_time", "min_position_limit", "max_position_limit", "present_position"):
            new.put(name, old.get(name))
        new.put("present_input_voltage", 120)
        new.put("firmware_version", 40)
        new.put("present_load", 250)
        robot.servos[i] = robot.line.servos[joints[i].id] = new
    robot.servos[2].put("present_current", 100)
    backend = DynamixelBackend(mixed, port=robot.line, clock=robot.line)
    sensors, motors = backend.connect()
    assert backend.differences == ()
    o = sensors.read()
    assert np.isnan(o.effort[:2]).all()
    assert o.effort[2] == pytest.approx(100 * 0.00269 * 1.783)
    np.testing.assert_allclose(o.position, ROBOT.home, atol=0.001)
    motors.write(active())
    assert all(servo.get("torque_enable") for servo in robot.servos)
    assert robot.servos[0].get("position_d_gain") == 4000, "the model's own"
    assert InstructionCode.FAST_SYNC_READ not in {p.instruction for p in robot.line.sent}


def test_a_port_must_be_named() -> None:
    with pytest.raises(BackendError, match="--port"):
        DynamixelBackend(ROBOT).connect()


# Torque --------------------------------------------------------------------------------------------------------------


def test_torque_comes_on_where_the_servo_is(robot: Robot) -> None:
    """Profile, goal and gains first, and the goal is the present position whatever the command says."""
    knee = robot.joint("l_knee")
    knee.put("present_position", 4096 + 2600)  # turned by hand while limp: it will say 2600 once torque is on
    sensors, motors = robot.backend().connect()
    sensors.read()
    motors.write(active(gain=0.5))
    names = [name for name, _ in knee.writes]
    on = knee.writes.index(("torque_enable", 1))
    assert names[:on] == [
        *("status_return_level", "bus_watchdog"),
        *("goal_velocity", "profile_acceleration", "profile_velocity", "goal_position"),
        *("velocity_i_gain", "velocity_p_gain", "position_d_gain", "position_i_gain", "position_p_gain"),
        *("feedforward_2nd_gain", "feedforward_1st_gain", "goal_pwm", "goal_current"),
    ]
    assert ("goal_position", 2600) in knee.writes[:on]
    assert ("position_p_gain", 400) in knee.writes[:on]
    assert knee.writes[on + 1 :] == [("bus_watchdog", 4), ("goal_position", 2048 + round(0.8524 / 2 / np.pi * 4096))]


def test_a_servo_that_has_torque_gets_no_gain_before_its_goal(robot: Robot) -> None:
    """Left damped by a program that ended, with a goal from then: gains alone would fling the knee there. Nor may the
    packet with the goal get lost."""
    knee = robot.joint("l_knee")
    for name, value in (("torque_enable", 1), ("position_p_gain", 0), ("goal_position", 3000)):
        knee.put(name, value)
    here = knee.get("present_position")
    pulled, deaf = [], [1]

    def watch(packet: codec.Packet) -> None:
        robot.live()
        goals = packet.instruction == InstructionCode.SYNC_WRITE and packet.params[:2] == b"\x68\x00"
        knee.answers = not (goals and deaf[0] > 0)
        deaf[0] -= goals
        if knee.get("torque_enable") and knee.get("position_p_gain"):
            pulled.append(knee.get("goal_position") - here)

    robot.line.before_answer = watch
    sensors, motors = robot.backend().connect()
    sensors.read()
    motors.write(active())
    assert deaf[0] < 0
    assert knee.get("position_p_gain") == 800
    assert pulled
    assert max(map(abs, pulled)) < 20


class Slow:
    """A guardian that has to be waited for, while somebody moves the knee."""

    def __init__(self, knee: Memory, by: int) -> None:
        self._knee, self._by = knee, by

    def hold(self) -> None:
        self._knee.put("present_position", self._knee.get("present_position") + self._by)

    def check(self) -> None: ...

    def let_go(self) -> None: ...

    def close(self) -> None: ...


@pytest.mark.parametrize("by", [40, 300])
def test_a_robot_that_is_moved_while_the_guardian_starts_does_not_leap(robot: Robot, by: int) -> None:
    """Neither to where it was when the wait began, nor to a first goal that was made of that."""
    knee = robot.joint("l_knee")
    sensors, motors = robot.backend().connect()
    motors._lifeline = Slow(knee, by)  # type: ignore[assignment]
    sensors.read()
    if by < 100:
        motors.write(active())
        first = next(value for name, value in knee.writes if name == "goal_position")
        assert first == knee.get("present_position")
    else:
        with pytest.raises(BackendError, match=r"l_knee \(ID 14\) moved before torque was on: .* start again"):
            motors.write(active())
        assert robot.moved() == []


def test_a_joint_that_cannot_be_reached_stays_limp(robot: Robot) -> None:
    robot.joint("l_knee").put("present_position", 100)
    sensors, motors = robot.backend().connect()
    sensors.read()
    with pytest.raises(BackendError, match=r"l_knee \(ID 14\) is beyond its servo's limits"):
        motors.write(active())
    assert not any(servo.get("torque_enable") for servo in robot.servos)


def test_torque_that_does_not_come_on_is_no_robot(robot: Robot) -> None:
    sensors, motors = robot.backend().connect()
    sensors.read()
    ankle = robot.joint("r_ank_roll")
    put = ankle.put
    ankle.put = lambda name, value: put(name, 0 if name == "torque_enable" else value)  # type: ignore[method-assign]
    with pytest.raises(BackendError, match=r"r_ank_roll \(ID 17\) did not switch torque on"):
        motors.write(active())
    assert not any(servo.get("torque_enable") for servo in robot.servos), "and the others are let go"


def test_goals_and_gains_follow_the_command(robot: Robot) -> None:
    sensors, motors = robot.backend().connect()
    run(robot, sensors, motors, 2)
    target = ROBOT.home + 0.1
    sent = len(robot.line.sent)
    motors.write(active(target))
    assert [p.instruction for p in robot.line.sent[sent:]] == [InstructionCode.SYNC_WRITE], "one packet a tick"
    elbow = robot.joint("l_el")
    assert elbow.get("goal_position") == 2048 + round((-0.5 + 0.1) / 2 / np.pi * 4096)
    motors.write(active(target, gain=0.25))
    assert elbow.get("position_p_gain") == 200


def test_damping_keeps_torque_with_no_gain_and_off_is_acknowledged(robot: Robot) -> None:
    sensors, motors = robot.backend().connect()
    motors.write(Command(ROBOT.home, np.ones(20), Mode.DAMP))
    assert robot.moved() == [], "a limp robot is not made stiff to be damped"
    run(robot, sensors, motors, 2)
    motors.write(Command(ROBOT.home, np.ones(20), Mode.DAMP))
    assert {(s.get("torque_enable"), s.get("position_p_gain"), s.get("position_d_gain")) for s in robot.servos} == {
        (1, 0, 0)
    }
    deaf = [2]

    def lose(packet: codec.Packet) -> None:
        """The first packets to switch torque off do not reach the left knee."""
        off = packet.instruction == InstructionCode.SYNC_WRITE and packet.params[:2] == b"\x40\x00"
        robot.joint("l_knee").answers = not (off and deaf[0] > 0)
        deaf[0] -= off

    robot.line.before_answer = lose
    motors.write(Command(ROBOT.home, np.ones(20), Mode.OFF))
    assert deaf[0] < 0
    assert not any(servo.get("torque_enable") for servo in robot.servos)


def test_torque_that_does_not_go_off_is_said(robot: Robot) -> None:
    backend = robot.backend()
    sensors, motors = backend.connect()
    run(robot, sensors, motors, 2)
    robot.joint("l_knee").answers = False
    with pytest.raises(BackendError, match=r"l_knee \(ID 14\) did not report that torque is off"):
        backend.close()
    assert robot.line.gone, "the port is given back all the same"
    assert sum(servo.get("torque_enable") for servo in robot.servos) == 1


@pytest.mark.parametrize("heard_by", ["the guardian", "closing"])
def test_torque_that_is_proven_off_after_all_is_no_longer_doubted(
    robot: Robot, heard_by: str, monkeypatch: pytest.MonkeyPatch
) -> None:
    """On a busy machine "20 of 20 off, acknowledged" was followed by "20 did not report that torque is off"."""

    class Guardian:
        def close(self) -> bool:
            return heard_by == "the guardian"

    backend = robot.backend()
    sensors, motors = backend.connect()
    run(robot, sensors, motors, 2)
    robot.joint("l_knee").answers = False
    with pytest.raises(BackendError, match=r"l_knee .*did not report") as raised:
        motors.write(Command(ROBOT.home, np.ones(20), Mode.OFF))
    robot.joint("l_knee").answers = heard_by == "closing"
    monkeypatch.setattr(backend, "_lifeline", Guardian())
    backend.close()
    assert "did not report" not in str(raised.value)
    assert "l_knee (ID 14) were late to say that torque is off: it is off now, ack" in str(raised.value)


def test_closing_lets_go(robot: Robot) -> None:
    backend = robot.backend()
    sensors, motors = backend.connect()
    run(robot, sensors, motors, 2)
    backend.close()
    assert not any(servo.get("torque_enable") for servo in robot.servos)
    backend.close()

"""What goes wrong on a scripted bus, and how the backend says so."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from scripted_op3 import ROBOT, TICK_NS, Robot, active, run

from servoid.hw.contracts.body import BackendError
from servoid.hw.dynamixel.backend import DynamixelBackend
from servoid.hw.faults import (
    IMU_DEAD,
    IMU_FROZEN,
    IMU_SILENT,
    REBOOTED,
    STOP_BUTTON,
    STOP_BUTTON_AGAIN,
    TORQUE_LOST,
    WATCHDOG,
    describe,
)


@pytest.fixture
def robot() -> Robot:
    return Robot()


@pytest.mark.parametrize("joint", ["head_pan", "l_knee", "r_ank_roll"])
@pytest.mark.parametrize("fault", ["torque", "reboot", "watchdog", "overload", "quiet overload"])
def test_what_servos_do_not_say_is_seen_within_a_few_ticks(robot: Robot, joint: str, fault: str) -> None:
    sensors, motors = robot.backend().connect()
    run(robot, sensors, motors, 3)
    servo = robot.joint(joint)
    expected = {"torque": TORQUE_LOST, "reboot": REBOOTED, "watchdog": WATCHDOG, "overload": 32, "quiet overload": 32}[
        fault
    ]
    if fault == "torque":
        servo.put("torque_enable", 0)
    elif fault == "reboot":
        servo.reboot()
    elif fault == "watchdog":
        servo.put("bus_watchdog", 255)
    elif fault == "overload":
        servo.put("hardware_error_status", 32)
    else:
        servo.quiet = True
        servo.put("hardware_error_status", 32)
    ticks, o = run(robot, sensors, motors, 10, lambda o: bool(o.fault.any()))
    assert ticks == 1 if fault == "overload" else ticks <= 6
    assert [ROBOT.names[i] for i in np.flatnonzero(o.fault)] == [joint]
    assert o.fault.max() & expected
    assert describe(int(o.fault.max()))


def test_an_error_does_not_let_torque_on(robot: Robot) -> None:
    robot.joint("l_knee").put("hardware_error_status", 4)
    sensors, motors = robot.backend().connect()
    assert sensors.read().fault[ROBOT.names.index("l_knee")] == 4
    with pytest.raises(BackendError, match=r"l_knee \(ID 14\) reports overheating"):
        motors.write(active())
    assert not any(servo.get("torque_enable") for servo in robot.servos)


def test_every_temperature_and_voltage_comes_round(robot: Robot) -> None:
    sensors, motors = robot.backend().connect()
    seen = np.full(20, np.nan)
    for _ in range(5):
        _, o = run(robot, sensors, motors, 1)
        assert np.isfinite(o.temperature).sum() == 4, "what was not read is not invented"
        seen = np.where(np.isfinite(o.temperature), o.temperature, seen)
    np.testing.assert_array_equal(seen, [30 + joint.id for joint in ROBOT.joints])


def test_a_silent_servo_is_nan_and_ages_and_the_others_stay(robot: Robot) -> None:
    sensors, motors = robot.backend().connect()
    run(robot, sensors, motors, 2)
    knee = ROBOT.names.index("l_knee")
    robot.servos[knee].answers = False
    ages = []
    for _ in range(4):
        _, o = run(robot, sensors, motors, 1)
        assert np.flatnonzero(np.isnan(o.position)).tolist() == [knee]
        ages.append(o.age[knee])
        assert np.delete(o.age, knee).max() < 0.02
        assert robot.line.time % TICK_NS < TICK_NS * 0.75, "the tick is not missed"
    assert np.diff(ages) == pytest.approx([0.02] * 3, abs=0.006)  # the first tick took longer


@pytest.mark.parametrize("kind", ["dead", "frozen", "silent"])
def test_an_imu_that_does_not_live_is_not_believed(robot: Robot, kind: str) -> None:
    sensors, motors = robot.backend().connect()
    run(robot, sensors, motors, 2)
    if kind == "silent":
        robot.board.answers = False
    else:
        robot.line.before_answer = None
        if kind == "dead":
            robot.board.put("acceleration_z", 0)
    ticks, o = run(robot, sensors, motors, 10, lambda o: bool(np.isnan(o.specific_force).all()))
    assert ticks <= 4
    _, o = run(robot, sensors, motors, 3)
    assert o.imu_age > 0.05
    assert (o.fault == {"dead": IMU_DEAD, "frozen": IMU_FROZEN, "silent": IMU_SILENT}[kind]).all(), "and it says why"
    assert np.isfinite(o.position).all()


@pytest.mark.parametrize("bits", [1, 2, 4, 7])
def test_the_boards_buttons_stop_the_robot(robot: Robot, bits: int) -> None:
    sensors, motors = robot.backend().connect()
    run(robot, sensors, motors, 2)
    robot.board.put("button", bits)
    for _ in range(3):
        _, o = run(robot, sensors, motors, 1)
        assert (o.fault == STOP_BUTTON).all()
    robot.board.put("button", 0)
    _, o = run(robot, sensors, motors, 1)
    assert (o.fault == STOP_BUTTON).all(), "letting go does not start it again"
    robot.board.put("button", bits)
    _, o = run(robot, sensors, motors, 1)
    assert (o.fault == STOP_BUTTON | STOP_BUTTON_AGAIN).all(), "pressed once more"


def test_only_the_buttons_that_the_robots_file_names_stop_it(robot: Robot) -> None:
    named = replace(ROBOT, bus=replace(ROBOT.bus, stop_buttons=("user",)))
    sensors, _ = DynamixelBackend(named, port=robot.line, clock=robot.line).connect()
    robot.board.put("button", 1 | 2 | 8)
    assert not sensors.read().fault.any()
    robot.board.put("button", 4)
    assert (sensors.read().fault == STOP_BUTTON).all()


def test_a_port_that_vanishes_is_said(robot: Robot) -> None:
    backend = robot.backend()
    sensors, motors = backend.connect()
    run(robot, sensors, motors, 2)
    robot.line.gone = True
    with pytest.raises(BackendError, match="gone"):
        sensors.read()
    with pytest.raises(BackendError, match="gone"):
        motors.write(active())
    with pytest.raises(BackendError, match="gone"):
        backend.close()

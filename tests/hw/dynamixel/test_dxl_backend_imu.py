"""A robot whose IMU has a port of its own: the backend reads that one, and the board for its buttons."""

from __future__ import annotations

from dataclasses import replace
from typing import ClassVar

import numpy as np
import pytest
from scripted_op3 import ROBOT, Robot, run

from servoid.hw.contracts.body import BackendError
from servoid.hw.dynamixel import backend as module
from servoid.hw.dynamixel.backend import DynamixelBackend
from servoid.hw.faults import IMU_FROZEN, STOP_BUTTON
from servoid.hw.imu.reading import Reading

OWN = replace(ROBOT, imu=replace(ROBOT.imu, kind="witmotion", port="/dev/imu", signs=(1.0, 1.0, 1.0)))


class FakeImu:
    opened: ClassVar[list[tuple[str | None, float]]] = []
    closed = 0

    def __init__(self, imu: object, slowest: float, *, clock: object) -> None:
        self.opened.append((imu.port, slowest))  # type: ignore[attr-defined]
        self.clock = clock
        self.fault = 0

    def read(self) -> Reading:
        now = self.clock.now_ns()  # type: ignore[attr-defined]
        if self.fault:
            return Reading(now - 200_000_000, self.fault)
        rate, force = np.array([0.1, 0.2, 0.3]), np.array([0.0, 0.0, 9.7])
        return Reading(now - 5_000_000, 0, rate, force, np.array([1.0, 0.0, 0.0, 0.0]))

    def close(self) -> None:
        type(self).closed += 1


@pytest.fixture
def robot(monkeypatch: pytest.MonkeyPatch) -> Robot:
    monkeypatch.setattr(module, "SerialImu", FakeImu)
    FakeImu.opened, FakeImu.closed = [], 0
    return Robot()


def test_the_named_imu_is_read_with_its_age(robot: Robot) -> None:
    backend = DynamixelBackend(OWN, port=robot.line, clock=robot.line)
    sensors, motors = backend.connect()
    assert FakeImu.opened == [("/dev/imu", 50)]
    robot.board.put("acceleration_z", 0)  # the board's own does not matter
    robot.line.before_answer = None
    for _ in range(5):
        _, o = run(robot, sensors, motors, 1)
    assert o.imu_age == pytest.approx(0.005, abs=0.003)
    assert o.angular_velocity.tolist() == [0.1, 0.2, 0.3]
    assert o.specific_force.tolist() == [0.0, 0.0, 9.7]
    assert o.orientation.tolist() == [1.0, 0.0, 0.0, 0.0]
    assert not o.fault.any()

    robot.board.put("button", 2)
    sensors._imu.fault = IMU_FROZEN
    _, o = run(robot, sensors, motors, 1)
    assert (o.fault == IMU_FROZEN | STOP_BUTTON).all()
    assert np.isnan(o.specific_force).all()
    assert o.imu_age > 0.2
    backend.close()
    assert FakeImu.closed == 1
    assert not any(servo.get("torque_enable") for servo in robot.servos)


def test_an_imu_that_does_not_open_leaves_servos_and_port_alone(robot: Robot, monkeypatch: pytest.MonkeyPatch) -> None:
    def absent(*_: object, **__: object) -> None:
        raise BackendError("/dev/imu: no such port")

    monkeypatch.setattr(module, "SerialImu", absent)
    with pytest.raises(BackendError, match="/dev/imu"):
        DynamixelBackend(OWN, port=robot.line, clock=robot.line).connect()
    assert robot.line.sent == [], "not even their power was switched on"
    assert robot.line.gone, "the bus is given back"


def test_servos_that_fail_give_the_imu_back(robot: Robot) -> None:
    robot.joint("l_knee").answers = False
    with pytest.raises(BackendError, match="l_knee"):
        DynamixelBackend(OWN, port=robot.line, clock=robot.line).connect()
    assert FakeImu.closed == 1

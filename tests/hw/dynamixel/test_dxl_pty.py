"""The backend on a virtual rig in a process of its own, over a real port."""

from __future__ import annotations

from collections.abc import Iterator

import numpy as np
import pytest

from servoid.hw.contracts.body import BackendError, Command, Mode
from servoid.hw.dynamixel.backend import DynamixelBackend
from servoid.hw.robot.description import load_robot
from servoid.sim.rig.process.control import LockedClock, RigProcess

ROBOT = load_robot("op3")


@pytest.fixture
def rig() -> Iterator[RigProcess]:
    with RigProcess(ROBOT) as rig:
        yield rig


@pytest.mark.slow
def test_it_is_found_read_driven_and_let_go(rig: RigProcess) -> None:
    clock = LockedClock(rig.control)
    backend = DynamixelBackend(ROBOT, port=rig.port, clock=clock)
    sensors, motors = backend.connect()
    with pytest.raises(BackendError, match="another program has the port"):
        DynamixelBackend(ROBOT, port=rig.port, clock=clock).connect()
    seen = np.full(20, np.nan)
    start = backend.clock.now_ns()
    for tick in range(30):
        backend.clock.sleep_until(start + tick * 20_000_000)
        o = sensors.read()
        seen = np.where(np.isfinite(o.position), o.position, seen)
        motors.write(Command(ROBOT.home, np.ones(20), Mode.ACTIVE))
    assert np.abs(seen - ROBOT.home).max() < 0.3
    assert np.isfinite(seen).all()
    motors.write(Command(ROBOT.home, np.ones(20), Mode.DAMP))
    backend.close()  # raises unless every servo says that torque is off
    again = DynamixelBackend(ROBOT, port=rig.port, clock=clock)
    again.connect()
    again.close()


def test_a_port_that_was_closed_is_not_read_as_silence(rig: RigProcess) -> None:
    backend = DynamixelBackend(ROBOT, port=rig.port, clock=LockedClock(rig.control))
    sensors, _ = backend.connect()
    sensors.read()
    backend.close()
    with pytest.raises(BackendError, match="gone"):
        sensors.read()

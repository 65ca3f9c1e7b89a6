"""The backend on a virtual rig in a process of its own, over a real port and in real time."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator

import numpy as np
import pytest

from servoid.hw.contracts.body import BackendError, Command, Mode
from servoid.hw.dynamixel.backend import DynamixelBackend
from servoid.hw.robot.description import load_robot

ROBOT = load_robot("op3")


@pytest.fixture
def port() -> Iterator[str]:
    server = subprocess.Popen(
        [sys.executable, "-m", "servoid.sim.rig.process.server", "--robot", "op3", "--linger", "30"],
        stdout=subprocess.PIPE,
        text=True,
    )
    assert server.stdout is not None
    try:
        yield json.loads(server.stdout.readline())["port"]
    finally:
        server.terminate()
        server.wait(120)
        server.stdout.close()


@pytest.mark.slow
def test_it_is_found_read_driven_and_let_go(port: str) -> None:
    """Nothing here depends on how busy the machine is, but that an answer comes at all."""
    backend = DynamixelBackend(ROBOT, port=port)
    sensors, motors = backend.connect()
    with pytest.raises(BackendError, match="another program has the port"):
        DynamixelBackend(ROBOT, port=port).connect()
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
    again = DynamixelBackend(ROBOT, port=port)
    again.connect()
    again.close()


def test_a_port_that_was_closed_is_not_read_as_silence(port: str) -> None:
    backend = DynamixelBackend(ROBOT, port=port)
    sensors, _ = backend.connect()
    sensors.read()
    backend.close()
    with pytest.raises(BackendError, match="gone"):
        sensors.read()

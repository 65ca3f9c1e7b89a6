"""A rig in this process, new for every test."""

from __future__ import annotations

import pytest
from rig_host import Host

from servoid.hw.robot.description import Robot, load_robot
from servoid.sim.rig.rig import Rig
from servoid.sim.rig.wire.faults import Scenario


@pytest.fixture(scope="session")
def robot() -> Robot:
    return load_robot()


@pytest.fixture(scope="session")
def shared_rig(robot: Robot) -> Rig:
    return Rig(robot)


@pytest.fixture
def rig(shared_rig: Rig) -> Rig:
    shared_rig.scenario = Scenario()
    shared_rig.reset(0)
    return shared_rig


@pytest.fixture
def host(rig: Rig, robot: Robot) -> Host:
    """A host whose servos have power."""
    host = Host(rig, robot)
    host.start()
    return host

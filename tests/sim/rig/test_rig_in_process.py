"""The virtual rig in its controller's process, as a body."""

from __future__ import annotations

import math
from dataclasses import replace

import numpy as np
import pytest

from servoid.hw.robot.description import Robot
from servoid.sim.rig.in_process import InProcessBackend
from servoid.sim.rig.rig import Rig


def test_a_robot_whose_imu_has_a_port_of_its_own_has_it_on_the_board(robot: Robot) -> None:
    """No such port is here: what its IMU measures comes over the bus, mounted as the robot's file says."""
    imu = replace(robot.imu, kind="witmotion", port="/nonexistent/imu", mounting=(math.pi / 2, 0.0, 0.0))
    body = InProcessBackend(Rig(replace(robot, imu=imu)))
    sensors, _ = body.connect()
    body.clock.sleep_until(body.clock.now_ns() + 20_000_000)
    seen = sensors.read()
    assert seen.specific_force[2] == pytest.approx(9.8, abs=0.3)
    assert np.isfinite(seen.angular_velocity).all()
    body.close()

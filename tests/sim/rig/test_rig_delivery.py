"""A rig that cannot be delivered as the robot's file says is refused, with what the file should say."""

from __future__ import annotations

from dataclasses import replace

import pytest

from hw.config import ConfigError
from hw.robot import Robot
from sim.rig.rig import Rig


def test_a_baud_that_servos_have_not_is_refused(robot: Robot) -> None:
    with pytest.raises(ConfigError, match=r"op3: bus.baud: servos have no 1500000 bit/s; they have 9600, 57600, .*"):
        Rig(replace(robot, bus=replace(robot.bus, baud=1_500_000)))

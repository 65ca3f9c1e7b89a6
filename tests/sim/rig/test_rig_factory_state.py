"""A rig that cannot be delivered as the robot's file says is refused, with what the file should say."""

from __future__ import annotations

from dataclasses import replace

import pytest

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import Robot
from servoid.sim.rig.rig import Rig


def test_a_baud_that_servos_have_not_is_refused(robot: Robot) -> None:
    with pytest.raises(ConfigError, match=r"op3: bus.baud: servos have no 1500000 bit/s; they have 9600, 57600, .*"):
        Rig(replace(robot, bus=replace(robot.bus, baud=1_500_000)))


@pytest.mark.parametrize(("key", "value"), [("ticks_per_turn", 1024), ("center_tick", 512)])
def test_ticks_that_the_emulated_servo_does_not_count_are_refused(robot: Robot, key: str, value: int) -> None:
    """Driver and servo would mean different angles by the same number."""
    own = replace(robot)  # whose servos are then replaced: they come from files
    own.__dict__["servos"] = tuple(replace(servo, **{"center_tick": 512, key: value}) for servo in robot.servos)
    with pytest.raises(ConfigError, match=f"servo xm430-w350: a virtual .* not .*{value}"):
        Rig(own)

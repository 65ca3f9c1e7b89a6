"""A robot on the gantry, in simulation: nothing else is near, and its base gives to no motion of a limb."""

from __future__ import annotations

import warnings
from typing import TYPE_CHECKING

from servoid.hw.robot.description import Robot
from servoid.hw.robot.mjcf import EXPECTED
from servoid.sim.model import FLOOR, spec

if TYPE_CHECKING:
    import mujoco

HELD = 1e6  # kg and kg m2 that a base has beside its own when it is held, as on a virtual rig
TOLERANCE = 1e-14  # of the solver, which would otherwise take the light limbs beside it for settled
BASE = slice(0, 6)  # of the degrees of freedom


def hanging_model(robot: Robot, *, collide: bool = False) -> mujoco.MjModel:
    """The robot's model without floor and sensors; `collide`: limbs touch each other. The base is yet to be held: how
    softly friction holds a joint is by the free robot, as in every other simulation of it."""
    body = spec(robot)
    for sensor in list(body.sensors):
        body.delete(sensor)
    body.delete(body.geom(FLOOR))
    if not collide:
        for geom in body.geoms:
            geom.contype = geom.conaffinity = 0
    body.option.tolerance = TOLERANCE
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", EXPECTED)
        return body.compile()

"""A robot on the gantry, in simulation: its base is fixed, and nothing else is near."""

from __future__ import annotations

import warnings

import mujoco

from servoid.hw.robot.description import Robot
from servoid.hw.robot.mjcf import EXPECTED
from servoid.sim.model import FLOOR, spec


def hanging_model(robot: Robot, *, collide: bool = False) -> mujoco.MjModel:
    """The robot's model without floor, sensors and the freedom of its base; `collide`: limbs touch each other."""
    body = spec(robot)
    for sensor in list(body.sensors):
        body.delete(sensor)
    for joint in list(body.body(robot.base).joints):
        body.delete(joint)
    body.delete(body.geom(FLOOR))
    if not collide:
        for geom in body.geoms:
            geom.contype = geom.conaffinity = 0
    with warnings.catch_warnings():
        warnings.filterwarnings("ignore", EXPECTED)
        return body.compile()

"""Joint limits as pure functions over any leading world dimensions: the same code in training and in the guard."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot


def clamp(target: Array, robot: Robot) -> Array:
    """Keep joint targets `(..., n_joints)` rad inside the ranges less the robot's margin."""
    margin = robot.limits.margin
    return np.clip(target, robot.lower + margin, robot.upper - margin)


def limit(target: Array, previous: Array, robot: Robot, ticks: int = 1) -> Array:
    """Limit joint targets in range and in rate.

    `target` and `previous`, the last accepted goal, are `(..., n_joints)` rad; `ticks` is how many ticks have passed
    since that goal was accepted. The result moves at most `joint_speed * dt * ticks` from `previous`, towards the
    clamped target, so that a goal that starts outside the range comes back at the limited speed.
    """
    step = robot.limits.joint_speed * robot.dt * ticks
    return np.clip(clamp(target, robot), previous - step, previous + step)

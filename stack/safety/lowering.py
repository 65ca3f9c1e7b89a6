"""The pose that the guard lowers a standing robot to, found from the geometry of its legs."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.hw.robot.legs import Legs
from servoid.stack.safety.limits import clamp

LOWEST = 0.7  # of the standing height: the knees still have range and torque to spare there
FORWARD = 0.4  # m ahead per m down: bent legs sag backward, 8 degrees in simulation without this and 2 with it
STEP = 0.005  # m, so that each solution starts near the next
TOLERANCE = 1e-5  # m and rad


def lowered_pose(robot: Robot) -> Array:
    """Joint positions `(n_joints,)` rad of a low, statically stable stance.

    Every sole stays as flat as it is at the home pose while the base comes down, and a little forward, in steps to
    `LOWEST` of the standing height, or as far as the joint ranges and the legs' geometry allow. The base stays over
    the feet as it is at home. Joints that belong to no leg keep their home position.
    """
    legs = Legs(robot)
    pose = robot.home.copy()
    place, rotation, _, _ = legs.forward(legs.pick(pose))
    for lowered in np.arange(STEP, (1.0 - LOWEST) * robot.standing_height + 1e-9, STEP):
        angles = _solve(legs, legs.pick(pose), place + lowered * np.array([-FORWARD, 0.0, 1.0]), rotation)
        if angles is None:
            break
        lower = pose.copy()
        lower[legs.index] = angles
        if not np.array_equal(clamp(lower, robot), lower):
            break
        pose = lower
    return pose


def _solve(legs: Legs, angles: Array, place: Array, rotation: Array) -> Array | None:
    """Angles `(n_legs, joints)` that put the last links at `place` `(n_legs, 3)`, turned by `rotation`, or None.

    Newton's method on the twist, damped so that a stretched leg does no harm. Joints that legs share stay as they are.
    """
    free = legs.own[:, None]
    for _ in range(30):
        at, turn, origins, axes = legs.forward(angles)
        between = turn @ np.swapaxes(rotation, -1, -2)
        twist = 0.5 * np.stack([between[:, j, i] - between[:, i, j] for i, j in ((1, 2), (2, 0), (0, 1))], -1)
        error = np.concatenate([at - place, twist], -1)  # (n_legs, 6)
        if np.abs(error).max() < TOLERANCE:
            return angles
        jacobian = np.concatenate([np.cross(axes, at[:, None] - origins), axes], -1).swapaxes(-1, -2) * free
        transposed = jacobian.swapaxes(-1, -2)
        damped = transposed @ jacobian + 1e-9 * np.eye(angles.shape[-1])
        angles = angles - np.linalg.solve(damped, (transposed @ error[..., None]))[..., 0]
    return None

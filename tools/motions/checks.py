"""Figures of what may be wrong with a clip, without physics."""

from __future__ import annotations

from typing import Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import rotate
from servoid.hw.robot.description import Robot
from servoid.hw.robot.legs import Legs
from servoid.policy.motion.clip import Clip, velocities
from servoid.tools.motions.standing import Standing

# What each figure may be at most. Soles are where servos that give under the robot's weight hold them, which a clip's
# goals allow for; what they give when the robot moves fast is not in it.
LIMITS = {
    "beyond_range_rad": 0.0,  # of the joints
    "speed_share": 1.0,  # of the speed that the guard allows
    "floating_mm": 2.0,  # lowest corner of a sole that carries, above the ground, 95th percentile
    "sinking_mm": 2.0,  # the same below it
    "slip_mmps": 5.0,  # of a sole that lies flat and carries, mean
}
FLAT = 0.004  # m: a sole whose corners differ by less in height lies flat


def check(clip: Clip, robot: Robot) -> dict[str, Any]:
    """The figures of `LIMITS`, and `wrong`, the names of those beyond. NaN where no foot carries."""
    beyond = float(np.maximum(robot.lower - clip.joints, clip.joints - robot.upper).max())
    speed = np.abs(velocities(clip, robot.dt)[0]).max() / robot.limits.joint_speed
    figures = {"beyond_range_rad": max(beyond, 0.0), "speed_share": float(speed), **_feet(clip, robot)}
    wrong = [name for name, most in LIMITS.items() if figures[name] > most + 1e-6]
    return {**figures, "wrong": wrong}


def _feet(clip: Clip, robot: Robot) -> dict[str, float]:
    corners = sole_corners(clip, robot, Standing(robot).held(clip))
    carries = clip.contact > 0.5
    lowest = corners[..., 2].min(-1)
    flat = carries & (np.ptp(corners[..., 2], axis=-1) < FLAT)
    step = np.linalg.norm(np.diff(corners[..., :2].mean(-2), axis=0), axis=-1) / robot.dt
    both = flat[1:] & flat[:-1]
    return {
        "floating_mm": 1e3 * float(np.percentile(np.maximum(lowest[carries], 0.0), 95)) if carries.any() else np.nan,
        "sinking_mm": 1e3 * float(np.percentile(np.maximum(-lowest[carries], 0.0), 95)) if carries.any() else np.nan,
        "slip_mmps": 1e3 * float(step[both].mean()) if both.any() else np.nan,
    }


def sole_corners(clip: Clip, robot: Robot, joints: Array) -> Array:
    """Corners of the soles `(ticks, n_feet, 4, 3)` m in the clip's frame, at the poses `joints` `(ticks, n_joints)`."""
    legs = Legs(robot)
    _, corners = legs.soles(legs.pick(joints))
    turn = clip.root_orientation[:, None, None, :]
    return rotate(turn, corners) + clip.root_position[:, None, None, :]

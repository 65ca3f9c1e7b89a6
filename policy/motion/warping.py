"""How far a motion is from a clip, whenever it does what the clip shows: dynamic time warping."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import headed, rotate, yaw_of


def seen_upright(points: Array, orientation: Array) -> Array:
    """Points `(ticks, points, 3)` m of the base frame in the heading frame, turned upright but with no place: tilt
    counts, and where the robot is and faces does not. `orientation` `(ticks, 4)` is that of the base."""
    return rotate(headed(orientation, -yaw_of(orientation))[:, None], points)


def warped_error(motion: Array, clip: Array, loop: bool = False) -> float:
    """Mean distance [m] between points of `motion` `(ticks, points, 3)` and of `clip` `(ticks, points, 3)`, each in
    its robot's frame, along the best warping of time; infinite without motion.

    The whole clip is looked for within the motion, which may do anything before and after it. What imitates a `loop`
    does nothing else: all of its motion is compared, beginning anywhere in the loop. A step of a path goes on by a
    frame in one of both, or in both; a path's mean is over its steps.
    """
    if not len(motion) or not len(clip):
        return float("inf")
    if loop:
        repeats = int(np.ceil(2.0 * len(motion) / len(clip))) + 1
        inner, outer = motion, np.tile(clip, (repeats, 1, 1))
    else:
        inner, outer = clip, motion
    # One row an inner frame: the least sum of a path that ends there, and how many steps it has.
    away = [np.linalg.norm(outer - frame, axis=-1).mean(-1) for frame in inner]
    total, steps = away[0].copy(), np.ones(len(outer))
    for row in away[1:]:
        before, counted = total, steps
        total, steps = before + row, counted + 1.0
        for j in range(1, len(outer)):
            ways = ((before[j], counted[j]), (before[j - 1], counted[j - 1]), (total[j - 1], steps[j - 1]))
            best = min(ways)
            total[j], steps[j] = best[0] + row[j], best[1] + 1.0
    return float((total / steps).min())

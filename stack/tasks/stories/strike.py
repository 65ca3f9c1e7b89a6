"""What struck a bag, of a whole trace: a pure function. A robot that walks a bag over has not struck it as told."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import rotate, up_vector
from servoid.policy.diffusion.prefix.key_points import KeyPoints
from servoid.stack.tasks.stories.condition import Moment

TIPS = np.cos(0.05)  # of a bag's upward axis: below that something has struck it
TRUNK = "trunk"


def struck_by(points: KeyPoints, now: Moment, bag: Array, size: Array, begin: int = 0) -> str | None:
    """The key point that is nearest to a bag as it first tips, or the trunk; None where it never does.

    `bag` `(ticks, 7)` are its poses and `size` `(3,)` m its sides; ticks before `begin` are not looked at.
    """
    tipped = np.flatnonzero(up_vector(bag[begin:, 3:])[:, 2] < TIPS)
    if not len(tipped):
        return None
    tick = begin + int(tipped[0])
    at = points(now.joints[tick])
    body = np.concatenate([at, np.zeros((1, 3))])
    places = now.base[tick] + rotate(np.broadcast_to(now.orientation[tick], (len(body), 4)), body)
    back = bag[tick, 3:] * np.array([1.0, -1.0, -1.0, -1.0])
    inside = rotate(np.broadcast_to(back, (len(body), 4)), places - bag[tick, :3])
    outside = np.maximum(np.abs(inside) - size / 2, 0.0)
    return (*points.names, TRUNK)[int(np.linalg.norm(outside, axis=-1).argmin())]

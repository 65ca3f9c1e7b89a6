"""What made a bag fall, of a whole trace: a pure function. A bag that is walked over was not struck as it was told."""

from __future__ import annotations

import math

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import rotate, up_vector
from servoid.policy.diffusion.prefix.key_points import KeyPoints
from servoid.stack.tasks.stories.condition import LIES, Moment

STANDS = math.cos(0.05)  # of a bag's upward axis: above that nothing makes it fall
TRUNK = "trunk"


def struck_by(points: KeyPoints, now: Moment, bag: Array, size: Array) -> str | None:
    """The key point that is nearest to a bag as it begins to lean for the last time before it lies, or the trunk; None
    where it does not fall.

    `points` are those of a whole body, of which toes count as feet; `bag` `(ticks, 7)` are the bag's poses and `size`
    `(3,)` m its sides.
    """
    upright = up_vector(bag[:, 3:])[:, 2]
    lies = np.flatnonzero(upright <= LIES)
    stood = np.flatnonzero(upright[: lies[0]] >= STANDS) if len(lies) else lies
    if not len(stood):
        return None
    tick = int(stood[-1]) + 1
    body = np.concatenate([points(now.joints[tick]), np.zeros((1, 3))])
    places = now.base[tick] + rotate(np.broadcast_to(now.orientation[tick], (len(body), 4)), body)
    back = bag[tick, 3:] * np.array([1.0, -1.0, -1.0, -1.0])
    inside = rotate(np.broadcast_to(back, (len(body), 4)), places - bag[tick, :3])
    outside = np.linalg.norm(np.maximum(np.abs(inside) - size / 2, 0.0), axis=-1)
    return (*points.names, TRUNK)[int(outside.argmin())].replace("toe", "foot")

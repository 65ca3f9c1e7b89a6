"""Between the odometry frame and the heading frame of a state."""

from __future__ import annotations

import math

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import State


def to_heading(points: Array, state: State) -> Array:
    """Points `(..., 2)` m of the odometry frame in the heading frame of `state`, from its base."""
    return turned(np.asarray(points, dtype=float) - state.displacement[:2], -float(state.yaw))


def turned(vectors: Array, angle: float) -> Array:
    """Vectors `(..., 2)` turned by `angle` [rad]."""
    cos, sin = math.cos(angle), math.sin(angle)
    return np.asarray(vectors, dtype=float) @ np.array([[cos, sin], [-sin, cos]])


def moving(obstacles: Array, velocity: Array) -> Array:
    """Obstacles `(n, 3)` with their velocity `(n, 2)`, as an instruction holds them: `(n, 5)`."""
    return np.concatenate([obstacles, np.broadcast_to(velocity, (len(obstacles), 2))], axis=-1)


def ahead(obstacles: Array, state: State) -> Array:
    """Obstacles `(n, 3)` of the odometry frame in the heading frame of `state`."""
    return np.concatenate([to_heading(obstacles[:, :2], state), obstacles[:, 2:]], axis=-1)

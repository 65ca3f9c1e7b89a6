"""Vectors, quaternions and frames over any leading dimensions; for a few numbers, quicker than numpy's own.

Quaternions are `(..., 4)` w x y z, and turn vectors of a body into the frame that the body is in.
"""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import State


def split(vectors: Array) -> tuple[Array, ...]:
    """Components of `(..., k)`: k arrays `(...)`."""
    return tuple(vectors[..., i] for i in range(vectors.shape[-1]))


def joined(*components: Array) -> Array:
    """Components `(...)` side by side: `(..., k)`."""
    out = np.empty((*np.shape(components[0]), len(components)))
    for i, component in enumerate(components):
        out[..., i] = component
    return out


def cross(a: Array, b: Array) -> Array:
    """Cross product of `(..., 3)` and `(..., 3)`, broadcast."""
    a0, a1, a2 = a[..., 0], a[..., 1], a[..., 2]
    b0, b1, b2 = b[..., 0], b[..., 1], b[..., 2]
    return joined(a1 * b2 - a2 * b1, a2 * b0 - a0 * b2, a0 * b1 - a1 * b0)


def multiply(a: Array, b: Array) -> Array:
    """Hamilton product of quaternions: first the turn `b`, then `a`."""
    aw, ax, ay, az = split(a)
    bw, bx, by, bz = split(b)
    return joined(
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def rotate(quaternion: Array, vector: Array) -> Array:
    """`(..., 3)` of the body, in the frame that it is in."""
    w, u = quaternion[..., :1], quaternion[..., 1:]
    t = 2.0 * cross(u, vector)
    return vector + w * t + cross(u, t)


def rotation_matrix(quaternion: Array) -> Array:
    """Rotation `(..., 3, 3)` of unit quaternions `(..., 4)`."""
    w, x, y, z = split(quaternion)
    rows = (
        (1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)),
        (2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)),
        (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)),
    )
    return np.stack([joined(*row) for row in rows], -2)


def up_vector(quaternion: Array) -> Array:
    """Upward unit vector seen from the body `(..., 3)`."""
    w, x, y, z = split(quaternion)
    return joined(2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))


def yaw_of(quaternion: Array) -> Array:
    """Heading `(...)` rad in -pi..pi."""
    w, x, y, z = split(quaternion)
    return np.arctan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def headed(quaternion: Array, angle: Array) -> Array:
    """Quaternions turned about the vertical by `angle` `(...)` rad."""
    c, s = np.cos(angle / 2), np.sin(angle / 2)
    w, x, y, z = split(quaternion)
    return joined(c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w)


def turned(vectors: Array, angle: Array | float) -> Array:
    """Vectors `(..., k)` turned about the vertical by `angle` `(...)` rad: what follows x and y stays as it is."""
    c, s = np.cos(angle), np.sin(angle)
    x, y, *up = split(np.asarray(vectors, dtype=float))
    return joined(c * x - s * y, s * x + c * y, *up)


def to_heading(points: Array, state: State) -> Array:
    """Points of the odometry frame in the heading frame of one robot's `state`, from its base.

    They are `(..., k)`: x and y [m], and what stays as it is, such as a radius.
    """
    moved = np.array(points, dtype=float)
    moved[..., :2] -= state.displacement[:2]
    return turned(moved, -state.yaw)

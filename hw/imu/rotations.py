"""Quaternions w x y z as plain tuples: for the one sample at a time that an IMU gives, quicker than arrays."""

from __future__ import annotations

import math

Quaternion = tuple[float, float, float, float]
Vector = tuple[float, float, float]
IDENTITY: Quaternion = (1.0, 0.0, 0.0, 0.0)


def about(axis: int, angle: float) -> Quaternion:
    """A turn of `angle` [rad] about axis 0, 1 or 2."""
    values = [math.cos(angle / 2), 0.0, 0.0, 0.0]
    values[axis + 1] = math.sin(angle / 2)
    return values[0], values[1], values[2], values[3]


def multiply(a: Quaternion, b: Quaternion) -> Quaternion:
    """Hamilton product."""
    aw, ax, ay, az = a
    bw, bx, by, bz = b
    return (
        aw * bw - ax * bx - ay * by - az * bz,
        aw * bx + ax * bw + ay * bz - az * by,
        aw * by - ax * bz + ay * bw + az * bx,
        aw * bz + ax * by - ay * bx + az * bw,
    )


def conjugate(q: Quaternion) -> Quaternion:
    """The opposite turn, of a unit quaternion."""
    return q[0], -q[1], -q[2], -q[3]


def yaw_pitch_roll(yaw: float, pitch: float, roll: float) -> Quaternion:
    """Turned about z, then about the new y, then about the new x [rad]."""
    return multiply(multiply(about(2, yaw), about(1, pitch)), about(0, roll))


def turn_between(before: Quaternion, after: Quaternion) -> Vector:
    """The turn from one orientation to another as a rotation vector [rad] in the body's frame: the shorter way."""
    w, x, y, z = multiply(conjugate(before), after)
    if w < 0.0:
        w, x, y, z = -w, -x, -y, -z
    sine = math.sqrt(x * x + y * y + z * z)
    scale = 2.0 * math.atan2(sine, w) / sine if sine > 1e-12 else 2.0
    return x * scale, y * scale, z * scale

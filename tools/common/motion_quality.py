"""How well a motion was made, pure functions of the true poses: floating, jerk and slip of the feet."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.hw.robot.legs import Legs

PLANTED = 0.002  # m: a sole all of whose corners are lower than this at both ends of a tick stands on the ground


@dataclass(frozen=True)
class Poses:
    """The true poses of a robot, one row a tick, in a frame whose z is up and zero on the ground."""

    dt: float
    position: Array  # (ticks, 3) m of the base
    yaw: Array  # (ticks,) rad
    up: Array  # (ticks, 3) unit vector upward, base frame
    joints: Array  # (ticks, n_joints) rad


def quality(poses: Poses, robot: Robot) -> dict[str, float]:
    """Floating [mm], jerk [m/s3] and foot slip [mm/s] of a motion; NaN where it is too short to tell."""
    from servoid.sim.kinematics import joint_places

    if len(poses.yaw) == 0:
        return dict.fromkeys(("floating_mm", "jerk_mps3", "foot_slip_mmps"), float("nan"))
    legs, rotation = Legs(robot), rotations(poses.yaw, poses.up)
    _, corners = legs.soles(legs.pick(poses.joints))
    corners = _placed(corners.reshape(len(corners), -1, 3), poses.position, rotation).reshape(corners.shape)
    places = _placed(joint_places(robot, poses.joints), poses.position, rotation)
    return {
        "floating_mm": 1e3 * floating(corners),
        "jerk_mps3": jerk(places, poses.dt),
        "foot_slip_mmps": 1e3 * foot_slip(corners, poses.dt),
    }


def floating(corners: Array) -> float:
    """Mean height [m] of the lowest point of the soles above the ground; below it counts as on it.

    `corners` is `(ticks, n_feet, 4, 3)` m. After PhysDiff, whose lowest point is of a body's mesh: here nothing but a
    sole comes to the ground without a fall.
    """
    return float(np.maximum(corners[..., 2].min((-1, -2)), 0.0).mean()) if len(corners) else float("nan")


def jerk(places: Array, dt: float) -> float:
    """Mean length of the third derivative [m/s3] of the places `(ticks, n, 3)` m; NaN for less than four ticks."""
    if len(places) < 4:
        return float("nan")
    return float(np.linalg.norm(np.diff(places, n=3, axis=0), axis=-1).mean() / dt**3)


def foot_slip(corners: Array, dt: float) -> float:
    """Mean speed over the ground [m/s] of the middles of soles that stand on it; NaN where none ever does.

    `corners` is `(ticks, n_feet, 4, 3)` m.
    """
    low = corners[..., 2].max(-1) < PLANTED
    planted = low[1:] & low[:-1]
    if not planted.any():
        return float("nan")
    steps = np.linalg.norm(np.diff(corners[..., :2].mean(-2), axis=0), axis=-1)
    return float(steps[planted].mean() / dt)


def rotations(yaw: Array, up: Array) -> Array:
    """Rotations `(ticks, 3, 3)` from the base's frame to the world's, from the heading and the upward vector.

    R = Rz(yaw) T, where T's last row is `up` and its first column has no part along y.
    """
    x, y, z = np.moveaxis(up / np.linalg.norm(up, axis=-1, keepdims=True), -1, 0)
    level = np.maximum(np.sqrt(1.0 - np.minimum(x * x, 1.0)), 1e-9)
    left = np.stack([np.zeros_like(x), z / level, -y / level], -1)
    upward = np.stack([x, y, z], -1)
    tilt = np.stack([np.cross(left, upward), left, upward], -2)
    cos, sin, zero, one = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw), np.ones_like(yaw)
    turn = np.stack([np.stack(r, -1) for r in ((cos, -sin, zero), (sin, cos, zero), (zero, zero, one))], -2)
    result: Array = turn @ tilt
    return result


def _placed(points: Array, position: Array, rotation: Array) -> Array:
    """Points `(ticks, n, 3)` of the base frame in the world's."""
    return position[:, None] + np.einsum("tij,tnj->tni", rotation, points)

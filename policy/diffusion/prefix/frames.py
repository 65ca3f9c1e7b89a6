"""Frames of a motion, each relative to the one before it, as in HumanML3D, and both conversions.

A heading is the turn about the vertical in the base's orientation (its twist): it stays defined while the robot lies,
where the base's x axis has no direction on the ground. `to_relative` and `to_global` are each other's inverse, take
numpy arrays or torch tensors and are differentiable.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.geometry import rotation_matrix, yaw_of
from servoid.hw.robot.description import Robot
from servoid.hw.robot.mirror import Mirror
from servoid.policy.diffusion.prefix.key_points import AnyArray, KeyPoints, Soles
from servoid.policy.features import Layout, raw_layout

RATE = 25.0  # frames a second


@dataclass(frozen=True)
class BodyMotion:
    """Frames of a motion in a frame of its own, z up from the ground; numpy arrays or torch tensors."""

    place: AnyArray  # (..., frames, 3) m of the base
    orientation: AnyArray  # (..., frames, 4) quaternion w x y z of the base
    joints: AnyArray  # (..., frames, n_joints) rad
    points: AnyArray  # (..., frames, points, 3) m of the key points
    contact: AnyArray  # (..., frames, n_feet) 0..1

    @property
    def heading(self) -> AnyArray:
        """rad about the vertical `(..., frames)`, within pi of zero."""
        return heading_of(self.orientation)


@dataclass(frozen=True)
class Anchor:
    """Where the frame before the first one is: what relative frames leave out."""

    place: AnyArray  # (..., 2) m of the base on the ground
    heading: AnyArray  # (...,) rad
    points: AnyArray  # (..., points, 3) m of the key points

    @staticmethod
    def before(motion: BodyMotion, frame: int = 0) -> Anchor:
        """The given frame of a motion."""
        return Anchor(motion.place[..., frame, :2], motion.heading[..., frame], motion.points[..., frame, :, :])


class Frames:
    """The conversions for one robot."""

    def __init__(self, robot: Robot) -> None:
        """Raises ConfigError for a robot whose rate is not a multiple of `RATE`."""
        self.stride = round(robot.rate / RATE)  # ticks from one frame to the next
        if self.stride * RATE != robot.rate:
            raise ConfigError(
                f"{robot.name} runs at {robot.rate:g} ticks a second: plans of {RATE:g} frames a second need a multiple"
            )
        self.robot, self.dt = robot, 1.0 / RATE
        self.key_points, self.soles = KeyPoints(robot), Soles(robot)
        n, points, feet = len(robot.joints), 3 * len(self.key_points.names), len(robot.legs)
        self.layout = Layout(
            (
                ("yaw_rate", 1),  # rad/s since the frame before
                ("velocity", 2),  # m/s since the frame before, in its heading frame
                ("height", 1),  # m of the base
                ("gravity", 3),  # unit vector, base frame
                ("position", n),  # rad
                ("points", points),  # m in the heading frame, from below the base
                ("point_velocity", points),  # m/s since the frame before, in the heading frame
                ("contact", feet),  # 0..1
            )
        )
        places = self.key_points.mirror()
        self.mirror = Mirror.join(
            Mirror.FLIPPED, Mirror.PLANAR, Mirror.SCALAR, Mirror.VECTOR, Mirror.joints(robot), places, places,
            Mirror.feet(robot),
        )  # fmt: skip

    def motion(self, place: Array, orientation: Array, joints: Array) -> BodyMotion:
        """A motion of given poses, with key points and contacts by kinematics; shapes as in `BodyMotion`."""
        turn = rotation_matrix(orientation)
        points = place[..., None, :] + np.einsum("...ij,...pj->...pi", turn, self.key_points(joints))
        return BodyMotion(place, orientation, joints, points, self.soles(place, turn, joints))

    def of_states(self, raw: Array) -> BodyMotion:
        """The motion of raw rows `(..., frames, raw size)`, which the estimator's states are."""
        row = raw_layout(len(self.robot.joints)).split(np.asarray(raw, dtype=float))
        lean = _lean(row["gravity"])
        orientation = _headed(lean, row["yaw"][..., 0] - yaw_of(lean))
        return self.motion(row["displacement"], orientation, row["position"])

    def to_relative(self, motion: BodyMotion) -> AnyArray:
        """Frames `(..., frames - 1, size)` of a motion, the first of whose frames is only what the second follows."""
        xp = _namespace(motion.place)
        heading = motion.heading
        turn = wrapped(heading[..., 1:] - heading[..., :-1])
        moved = motion.place[..., 1:, :2] - motion.place[..., :-1, :2]
        below = motion.points[..., 1:, :, :] - _ground(motion.place[..., 1:, :])[..., None, :]
        shifted = motion.points[..., 1:, :, :] - motion.points[..., :-1, :, :]
        here = -heading[..., 1:, None]
        lead = turn.shape
        parts = [
            turn[..., None] / self.dt,
            turned(moved, -heading[..., :-1]) / self.dt,
            motion.place[..., 1:, 2:],
            _gravity(motion.orientation[..., 1:, :]),
            motion.joints[..., 1:, :],
            turned(below, here).reshape(*lead, -1),
            turned(shifted, here).reshape(*lead, -1) / self.dt,
            motion.contact[..., 1:, :],
        ]
        return xp.concat(parts, -1)

    def to_global(self, frames: AnyArray, before: Anchor | None = None) -> BodyMotion:
        """The motion of frames `(..., frames, size)` that follow `before`; None: a frame at the origin, along x.

        What the network predicts need not agree with itself: the key points are those of the frames, not those of the
        joints, and their velocities are left out.
        """
        xp, feature = _namespace(frames), self.layout.split(frames)
        turn = feature["yaw_rate"][..., 0] * self.dt
        start = 0.0 if before is None else before.heading[..., None]
        heading = start + turn.cumsum(-1)
        moved = (turned(feature["velocity"], heading - turn) * self.dt).cumsum(-2)
        if before is not None:
            moved = moved + before.place[..., None, :]
        place = xp.concat([moved, feature["height"]], -1)
        points = feature["points"].reshape(*turn.shape, -1, 3)
        return BodyMotion(
            place,
            _headed(_lean(feature["gravity"]), heading),
            feature["position"],
            turned(points, heading[..., None]) + _ground(place)[..., None, :],
            feature["contact"],
        )

    def end_points(self, frames: AnyArray) -> tuple[AnyArray, AnyArray, AnyArray]:
        """Where the last of frames `(..., frames, size)` leaves the body, in the heading frame that they begin in.

        Its base `(..., 3)` m, its heading `(...)` rad, with its turns, and its key points `(..., points, 3)` m: by the
        kinematics of the joints, since it is joints that are followed.
        """
        last = self.to_global(frames)
        heading = (self.layout.split(frames)["yaw_rate"][..., 0] * self.dt).sum(-1)
        local = self.key_points(last.joints[..., -1, :])
        return (
            last.place[..., -1, :],
            heading,
            last.place[..., -1, None, :] + _rotated(last.orientation[..., -1, None, :], local),
        )


def heading_of(orientation: AnyArray) -> AnyArray:
    """Twist about the vertical of quaternions `(..., 4)`: `(...)` rad within pi of zero."""
    xp = _namespace(orientation)
    return wrapped(2.0 * xp.arctan2(orientation[..., 3], orientation[..., 0]))


def wrapped(angle: AnyArray) -> AnyArray:
    """The same angle [rad] within pi of zero: half a turn stays half a turn."""
    xp = _namespace(angle)
    return xp.arctan2(xp.sin(angle), xp.cos(angle))


def turned(vectors: AnyArray, angle: AnyArray) -> AnyArray:
    """Vectors `(..., k)` turned about the vertical by `angle` `(...)` rad: what follows x and y stays as it is."""
    xp = _namespace(vectors)
    c, s = xp.cos(angle), xp.sin(angle)
    x, y = vectors[..., 0], vectors[..., 1]
    planar = xp.stack([c * x - s * y, s * x + c * y], -1)
    return planar if vectors.shape[-1] == 2 else xp.concat([planar, vectors[..., 2:]], -1)


def _ground(place: AnyArray) -> AnyArray:
    """Points `(..., 3)` on the ground below `place`."""
    return place * (np.array([1.0, 1.0, 0.0]) if isinstance(place, np.ndarray) else place.new_tensor([1.0, 1.0, 0.0]))


def _gravity(orientation: AnyArray) -> AnyArray:
    """Unit vector along gravity in the base frame `(..., 3)`."""
    w, x, y, z = (orientation[..., i] for i in range(4))
    up = (2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y))
    return -_namespace(orientation).stack(up, -1)


def _lean(gravity: AnyArray) -> AnyArray:
    """The least turn `(..., 4)` that leaves gravity along `(..., 3)`, of whatever length, in the base frame.

    It is about a level axis, so that its heading is zero. A base that stands on its head has none.
    """
    xp = _namespace(gravity)
    length = xp.sqrt((gravity * gravity).sum(-1) + 1e-12)
    x, y, z = (-gravity[..., i] / length for i in range(3))
    w = 1.0 + z
    quaternion = xp.stack([w, y, -x, 0.0 * w], -1)
    return quaternion / xp.sqrt((quaternion * quaternion).sum(-1)[..., None] + 1e-12)


def _headed(lean: AnyArray, heading: AnyArray) -> AnyArray:
    """Quaternions `(..., 4)` turned about the vertical by `heading` `(...)` rad."""
    xp = _namespace(lean)
    c, s = xp.cos(heading / 2), xp.sin(heading / 2)
    w, x, y, z = (lean[..., i] for i in range(4))
    return xp.stack([c * w - s * z, c * x - s * y, c * y + s * x, c * z + s * w], -1)


def _rotated(quaternion: AnyArray, vector: AnyArray) -> AnyArray:
    """Vectors `(..., 3)` of the body in the frame that it is in."""
    xp = _namespace(quaternion)
    w, x, y, z = (quaternion[..., i] for i in range(4))
    a, b, c = (vector[..., i] for i in range(3))
    # t = 2 u x v;  v + w t + u x t
    ta, tb, tc = 2 * (y * c - z * b), 2 * (z * a - x * c), 2 * (x * b - y * a)
    return xp.stack([a + w * ta + y * tc - z * tb, b + w * tb + z * ta - x * tc, c + w * tc + x * tb - y * ta], -1)


def _namespace(x: AnyArray) -> Any:
    if isinstance(x, np.ndarray | float | np.floating):
        return np
    import torch

    return torch

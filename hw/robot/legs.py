"""Leg kinematics of the described robot, vectorised: forward kinematics, foot velocities and analytic inverse.

Arrays carry any leading dimensions, then legs in the order of the robot's file: `(..., n_legs, joints of a leg)`.
"""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.geometry import cross

if TYPE_CHECKING:
    from servoid.hw.robot.description import Robot

ALONG = 0.7  # of a joint's axis along the base's, that it counts for
_ANKLE = 0.4  # of a leg's length: joints this near the sole belong to the ankle


def _skew(axis: Array) -> Array:
    x, y, z = axis
    return np.array([[0.0, -z, y], [z, 0.0, -x], [-y, x, 0.0]])


def rotations(angles: Array, axes: Array) -> Array:
    """Turns by `angles` `(n,)` rad about `axes` `(n, 3)`, by Rodrigues' formula: `(n, 3, 3)`."""
    skew = np.array([_skew(axis) for axis in axes])
    sin, cos = np.sin(angles)[:, None, None], 1.0 - np.cos(angles)[:, None, None]
    return np.eye(3) + sin * skew + cos * (skew @ skew)


class Legs:
    """Kinematics of the legs, which have equally many joints."""

    def __init__(self, robot: Robot) -> None:
        legs = list(robot.legs.values())
        self.index = robot.leg_index
        counts = np.bincount(self.index.ravel())
        self.own = (counts[self.index] == 1).astype(
            float
        )  # (legs, joints): 0 for joints that legs share, such as a waist
        self.names = [[link.joint for link in leg] for leg in legs]
        self.offset = np.array([[link.offset for link in leg] for leg in legs])  # (legs, joints, 3)
        self.axis = np.array([[link.axis for link in leg] for leg in legs], dtype=float)
        skew = np.array([[_skew(axis) for axis in leg] for leg in self.axis])
        self._skew, self._skew2 = skew, skew @ skew
        feet = [robot.feet[name] for name in robot.legs]
        # The foot's frame is at the last joint, turned as its sole.
        body, axes = np.array([foot.body_axes for foot in feet]), np.array([foot.axes for foot in feet])
        turn = body @ axes
        self._foot = None if np.array_equal(turn, np.broadcast_to(np.eye(3), turn.shape)) else turn
        self.level = self._foot is None  # whether soles are along the base's axes at zero angles
        at = np.array([foot.body_place for foot in feet]) + np.einsum("lij,lj->li", body, [foot.sole for foot in feet])
        self.sole = np.einsum("lji,lj->li", turn, at)  # (legs, 3) in the foot's frame
        signs = np.array([[sx, sy, 0.0] for sx in (1, -1) for sy in (1, -1)])
        half = np.array([(*foot.half_size, 0.0) for foot in feet])
        self.corners = self.sole[:, None] + signs * half[:, None]  # (legs, 4, 3)

    def pick(self, joints: Array) -> Array:
        """Leg joints `(..., n_legs, joints of a leg)` out of `(..., n_joints)`."""
        return joints[..., self.index]

    def forward(self, q: Array) -> tuple[Array, Array, Array, Array]:
        """Pose of each foot's frame in the base frame: at the leg's last joint, turned as the sole.

        `q` is `(..., n_legs, joints)` rad. Returns position `(..., n_legs, 3)` m, rotation `(..., n_legs, 3, 3)`, and
        for velocities the joints' origins and axes, `(..., n_legs, joints, 3)`, all in the base frame.
        """
        sin, cos = np.sin(q)[..., None, None], 1.0 - np.cos(q)[..., None, None]
        turn = np.eye(3) + sin * self._skew + cos * self._skew2  # Rodrigues
        rotation = np.broadcast_to(np.eye(3), (*q.shape[:-1], 3, 3))
        position = np.zeros((*q.shape[:-1], 3))
        origins, axes = [], []
        for j in range(q.shape[-1]):
            position = position + np.einsum("...ij,...j->...i", rotation, self.offset[:, j])
            origins.append(position)
            axes.append(np.einsum("...ij,...j->...i", rotation, self.axis[:, j]))
            rotation = rotation @ turn[..., j, :, :]
        if self._foot is not None:
            rotation = rotation @ self._foot
        return position, rotation, np.stack(origins, -2), np.stack(axes, -2)

    def velocity(self, point: Array, origins: Array, axes: Array, dq: Array) -> tuple[Array, Array]:
        """Velocity of `point` `(..., n_legs, 3)` of the last links, and their angular velocity, relative to the base.

        `dq` is `(..., n_legs, joints)` rad/s; both results are `(..., n_legs, 3)` in the base frame.
        """
        rates = axes * dq[..., None]
        linear = cross(rates, point[..., None, :] - origins).sum(-2)
        return linear, rates.sum(-2)

    def soles(self, q: Array) -> tuple[Array, Array]:
        """Centres `(..., n_legs, 3)` and corners `(..., n_legs, 4, 3)` of the soles in the base frame."""
        position, rotation, _, _ = self.forward(q)
        centre = position + np.einsum("...ij,...j->...i", rotation, self.sole)
        corners = position[..., None, :] + np.einsum("...ij,...kj->...ki", rotation, self.corners)
        return centre, corners

    def stand(self, joints: Array) -> tuple[Array, Array]:
        """How the base stands in a pose `(..., n_joints)` whose first foot is flat on the ground.

        Returns its height `(...,)` m and its quaternion `(..., 4)` w x y z, of no yaw.
        """
        position, rotation, _, _ = self.forward(self.pick(joints))
        up = rotation[..., 0, :, 2]  # the ground's normal, seen from the base
        pitch = np.arctan2(-up[..., 0], up[..., 2])
        roll = np.arctan2(up[..., 1], np.hypot(up[..., 0], up[..., 2]))
        corners = position[..., None, :] + np.einsum("...ij,...kj->...ki", rotation, self.corners)
        height = -np.einsum("...lki,...i->...lk", corners, up).min((-1, -2))
        cr, sr, cp, sp = np.cos(roll / 2), np.sin(roll / 2), np.cos(pitch / 2), np.sin(pitch / 2)
        return height, np.stack([cp * cr, cp * sr, sp * cr, -sp * sr], -1)

    def turning(self, joints: Array, axis: int, *, ankle: bool) -> tuple[Array, Array]:
        """Each leg's joint that turns about this axis of the base, in a pose `(n_joints,)`: the last of its ankle, or
        the first above that, of its hip.

        Returns their numbers among the robot's joints and the signs of their axes along that one, both `(n,)`: none of
        a leg that has no such joint.
        """
        q = self.pick(joints)
        soles, (_, _, origins, axes) = self.soles(q)[0], self.forward(q)
        length = np.linalg.norm(origins[:, 0] - soles, axis=-1)
        numbers, signs = [], []
        for leg, row in enumerate(self.index):
            near = np.linalg.norm(origins[leg] - soles[leg], axis=-1) < _ANKLE * length[leg]
            found = np.flatnonzero((near == ankle) & (np.abs(axes[leg, :, axis]) > ALONG))
            if len(found):
                joint = found[-1 if ankle else 0]
                numbers.append(row[joint])
                signs.append(np.sign(axes[leg, joint, axis]))
        return np.array(numbers, int), np.array(signs)


class LegInverse:
    """Analytic inverse kinematics of legs of the order yaw, roll, pitch, knee, ankle pitch, ankle roll.

    The hip's three axes and the ankle's two must each meet in a point (to 1 mm). Method: S. Kajita et al.,
    Introduction to Humanoid Robotics, section 2.5. Raises ConfigError for legs of another build.
    """

    ORDER = np.array([2, 0, 1, 1, 1, 0])  # coordinate axis of each joint: z x y y y x

    @classmethod
    def misfit(cls, legs: Legs) -> str | None:
        """Why it does not hold for these legs; None if it does."""
        axis, offset = legs.axis, legs.offset
        if axis.shape[1] != 6 or not np.array_equal(np.abs(axis).argmax(-1), np.tile(cls.ORDER, (len(axis), 1))):
            return "legs are not of yaw, roll, pitch, knee, ankle pitch, ankle roll"
        if np.abs(axis).max(-1).min() < 1 - 1e-6 or not legs.level:
            return "an axis or a sole is not along the base's axes at zero angles"
        hip = [offset[:, 1, 1], offset[:, 1, 0] + offset[:, 2, 0], offset[:, 2, 2]]  # between the axes
        leg = [offset[:, 3, 0], offset[:, 4, 0], offset[:, 5, 2], offset[:, 2:, 1].sum(-1)]  # off the straight line
        if np.abs([*hip, *leg]).max() > 1e-3:
            return "the axes do not meet in a point at the hip and at the ankle"
        return None

    def __init__(self, legs: Legs, name: str) -> None:
        axis, offset = legs.axis, legs.offset
        if (why := self.misfit(legs)) is not None:
            raise ConfigError(f"{name}: {why}")
        self.sign = np.take_along_axis(axis, np.tile(self.ORDER, (len(axis), 1))[..., None], -1)[..., 0]
        self.thigh, self.shank = -offset[:, 3, 2], -offset[:, 4, 2]
        # The pitch joints lie beside the leg's plane: their sideways offset is undone at the ankle.
        self.hip = offset[:, 0] + offset[:, 1] + offset[:, 2] * np.array([1.0, 0.0, 1.0])
        # From the last link's origin, on the ankle's roll axis, to where that axis meets the pitch axis.
        self.ankle = -offset[:, 5] * np.array([1.0, 0.0, 0.0])
        self.sole = legs.sole

    def __call__(self, ankle: Array, rotation: Array) -> Array:
        """Leg joints `(..., n_legs, 6)` rad that put the ankles at `ankle` with the feet turned by `rotation`.

        `ankle` is `(..., n_legs, 3)` m in the base frame, `rotation` `(..., n_legs, 3, 3)`. A point out of reach gives
        the stretched leg.
        """
        r = np.einsum("...ji,...j->...i", rotation, self.hip - ankle)
        x, y, z = r[..., 0], r[..., 1], r[..., 2]
        a, b = self.thigh, self.shank
        reach = np.clip(np.sqrt((r * r).sum(-1)), 1e-3, 0.9999 * (a + b))
        knee = np.arccos(np.clip((reach**2 - a**2 - b**2) / (2 * a * b), -1.0, 1.0))
        lean = np.arcsin(np.clip(a / reach * np.sin(knee), -1.0, 1.0))
        ankle_roll = np.arctan2(y, z)
        ankle_pitch = -np.arctan2(x, np.sqrt(y * y + z * z)) - lean
        bend = -(ankle_pitch + knee)
        # Rotation of the thigh = foot @ RotX(-ankle roll) @ RotY(bend), read as yaw, roll, pitch.
        cr, sr, cp, sp = np.cos(ankle_roll), np.sin(ankle_roll), np.cos(bend), np.sin(bend)
        ex, ey, ez = rotation[..., 0], rotation[..., 1], rotation[..., 2]
        cy, cz = cr[..., None] * ey - sr[..., None] * ez, sr[..., None] * ey + cr[..., None] * ez
        tx = cp[..., None] * ex - sp[..., None] * cz
        tz = sp[..., None] * ex + cp[..., None] * cz
        yaw = np.arctan2(-cy[..., 0], cy[..., 1])
        roll = np.arctan2(cy[..., 2], -cy[..., 0] * np.sin(yaw) + cy[..., 1] * np.cos(yaw))
        pitch = np.arctan2(-tx[..., 2], tz[..., 2])
        return np.stack([yaw, roll, pitch, knee, ankle_pitch, ankle_roll], -1) * self.sign

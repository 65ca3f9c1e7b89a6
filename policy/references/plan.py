"""A plan as a reference: poses at the robot's rate, each world's its own, that go over into those of the next plan."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Reference, ReferenceFrames
from servoid.hw.geometry import headed, turned, yaw_of
from servoid.hw.robot.description import Robot
from servoid.policy.features import Layout
from servoid.policy.motion.clip import smooth
from servoid.policy.references.clip import BLEND_SHARE

_PEAK = 1.875  # of a minimum-jerk blend's speed over its mean


def row_layout(robot: Robot) -> Layout:
    """A pose as a row: what a plan says of a tick."""
    return Layout(
        (
            ("place", 3),  # m of the base, in a frame that the whole plan shares; z above the ground
            ("orientation", 4),  # quaternion w x y z of the base
            ("position", len(robot.joints)),  # rad
            ("contact", len(robot.legs)),  # 0..1
        )
    )


class PlanReference(Reference):
    """Follows plans, one after the other, in worlds of any leading `shape`. It begins standing at home, and holds the
    last pose of a plan that has ended, at rest."""

    def __init__(self, robot: Robot, shape: tuple[int, ...] = ()) -> None:
        self._robot, self._layout, self._shape = robot, row_layout(robot), shape
        self._speed = BLEND_SHARE * robot.limits.joint_speed * robot.dt
        self._offset = np.zeros((*shape, len(robot.joints)))  # of what was followed before the plan
        self._blend = np.ones(shape)  # ticks over which it fades
        self.stand(np.broadcast_to(robot.home, (*shape, len(robot.joints))))

    def reset(self, where: Array | slice = slice(None)) -> None:
        """Stand at home in the worlds `where` (default: all)."""
        home = np.broadcast_to(self._robot.home, (*self._shape, len(self._robot.joints)))
        if not self._shape or isinstance(where, slice):
            self.stand(home)
        else:
            self.stand(home, where)

    def stand(self, joints: Array, where: Array | None = None) -> None:
        """Hold the joints `(..., n_joints)` rad, upright, in the worlds `where` `(...,)` bool (default: all)."""
        rows = np.zeros((*self._shape, 2, self._layout.size))
        rows[..., self._layout.slice("place")] = [0.0, 0.0, self._robot.standing_height]
        rows[..., self._layout.slice("orientation")] = [1.0, 0.0, 0.0, 0.0]
        rows[..., self._layout.slice("position")] = joints[..., None, :]
        rows[..., self._layout.slice("contact")] = 1.0
        if where is None:
            self._take(rows)
            self._offset = np.zeros_like(self._offset)
            return
        kept = self._rows[..., min(self.time, self._last) :, :]
        count = max(kept.shape[-2], 2)
        self._take(np.where(where[..., None, None], _padded(rows, count), _padded(kept, count)))
        self._offset = np.where(where[..., None], 0.0, self._offset)

    def follow(self, rows: Array) -> None:
        """Go over to a plan: `rows` `(..., ticks, row size)`, the first being the pose to be in at the next tick."""
        before = self.frames(np.zeros(1, int)).position[..., 0, :]
        self._take(rows)
        self._offset = before - rows[..., 0, self._layout.slice("position")]
        self._blend = np.maximum(np.ceil(_PEAK * np.abs(self._offset).max(-1) / self._speed), 1.0)

    def _take(self, rows: Array) -> None:
        rows = _padded(rows, 2)
        part, dt = self._layout.split(rows), self._robot.dt
        self.time, self._last, self._rows = 0, rows.shape[-2] - 1, rows
        self._part = part
        self._joint_velocity = np.gradient(part["position"], dt, axis=-2)
        self._yaw = np.unwrap(yaw_of(part["orientation"]), axis=-1)
        self._yaw_rate = np.gradient(self._yaw, dt, axis=-1)
        self._velocity = turned(np.gradient(part["place"][..., :2], dt, axis=-2), -self._yaw)

    @property
    def ended(self) -> Array:
        return np.full(self._shape, self.time >= self._last)

    def advance(self) -> None:
        self.time += 1

    def frames(self, ahead: Array) -> ReferenceFrames:
        time = self.time + np.asarray(ahead)
        at = np.clip(time, 0, self._last)
        moving = (time < self._last).astype(float)
        here = min(self.time, self._last)
        share = np.clip(time / self._blend[..., None], 0.0, 1.0)
        offset = (1.0 - smooth(share))[..., None] * self._offset[..., None, :]
        slope = 30.0 * share**2 * (1.0 - share) ** 2 / (self._blend[..., None] * self._robot.dt)
        place, facing = self._part["place"][..., at, :], self._yaw[..., here, None]
        root = turned(place - self._part["place"][..., here, None, :], -facing)
        root[..., 2] = place[..., 2]
        position = self._part["position"][..., at, :] + offset
        fading = slope[..., None] * self._offset[..., None, :]
        return ReferenceFrames(
            position=np.clip(position, self._robot.lower, self._robot.upper),
            joint_velocity=self._joint_velocity[..., at, :] * moving[:, None] - fading,
            velocity=self._velocity[..., at, :] * moving[:, None],
            yaw_rate=self._yaw_rate[..., at] * moving,
            height=place[..., 2],
            root_position=root,
            root_orientation=headed(self._part["orientation"][..., at, :], -facing),
            contact=self._part["contact"][..., at, :],
        )


def _padded(rows: Array, least: int) -> Array:
    """Rows `(..., ticks, size)` with the last one repeated up to `least` ticks."""
    missing = least - rows.shape[-2]
    return rows if missing <= 0 else np.concatenate([rows, np.repeat(rows[..., -1:, :], missing, -2)], -2)

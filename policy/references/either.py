"""The gait or a clip, whichever each world follows now: what is begun blends in from the pose that the robot is in."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import fields

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Reference, ReferenceFrames
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import Clip, smooth
from servoid.policy.references.clip import ClipReference
from servoid.policy.references.gait import Gait, GaitSettings

_BLEND_SECONDS = 0.5  # from a clip's end, which stands at home or nearly, to the gait


class GaitOrClip(Reference):
    """Two references of leading dimensions `shape`: `gait`, to be commanded, and `clip`. It begins with the gait."""

    def __init__(
        self, robot: Robot, clips: Sequence[Clip], shape: tuple[int, ...] = (), settings: GaitSettings | None = None
    ) -> None:
        """`settings` are the gait's, by default the robot's own. Raises ConfigError without a clip, or where one leaves
        the joint ranges."""
        self.gait, self.clip = Gait(robot, shape, settings), ClipReference(robot, clips, shape)
        self.on_clip = np.zeros(shape, bool)
        self._offset = np.zeros((*shape, len(robot.joints)))  # of the pose that the gait was entered in
        self._since = np.zeros(shape)
        self._blend = round(_BLEND_SECONDS / robot.dt)

    def reset(self, where: Array | slice = slice(None)) -> None:
        """Stand, in the worlds `where` (default: all)."""
        self.gait.reset(where)
        self.clip.reset(where)
        self.on_clip[() if self.on_clip.ndim == 0 else where] = False
        self._offset[() if self.on_clip.ndim == 0 else where] = 0.0

    def play(
        self, clip: Array | int, joints: Array, where: Array, *, time: Array | float = 0.0, rate: Array | float = 1.0
    ) -> None:
        """Follow clips by their index from `time` [ticks] on in the worlds `where` `(...,)` bool, whose joints are
        commanded to `joints` `(..., n_joints)` rad now."""
        self.clip.play(clip, time=time, rate=rate, where=where)
        self.clip.enter(joints, where)
        self.on_clip = self.on_clip | where

    def stand(self, joints: Array, where: Array) -> None:
        """Go over to the gait, standing, in the worlds `where` `(...,)` bool, likewise."""
        self.gait.reset(where if self.on_clip.ndim else slice(None))
        home = self.gait.frames(np.zeros(1, int)).position[..., 0, :]
        self._offset = np.where(where[..., None], joints - home, self._offset)
        self._since = np.where(where, 0.0, self._since)
        self.on_clip = self.on_clip & ~where

    def led(self, target: Array) -> Array:
        """See `Gait.led`: joint targets `(..., n_joints)` rad, of worlds that follow the gait."""
        return np.where(self.on_clip[..., None], target, self.gait.led(target))

    @property
    def ended(self) -> Array:
        return self.on_clip & self.clip.ended

    def advance(self) -> None:
        self.gait.advance()
        self.clip.advance()
        self._since = np.asarray(self._since + 1.0)

    def frames(self, ahead: Array) -> ReferenceFrames:
        walk, play = self.gait.frames(ahead), self.clip.frames(ahead)
        left = 1.0 - smooth((self._since[..., None] + np.asarray(ahead)) / self._blend)
        walk.position[...] += left[..., None] * self._offset[..., None, :]
        chosen = {}
        for field in fields(ReferenceFrames):
            gait, clip = getattr(walk, field.name), getattr(play, field.name)
            on_clip = self.on_clip.reshape(self.on_clip.shape + (1,) * (gait.ndim - self.on_clip.ndim))
            chosen[field.name] = np.where(on_clip, clip, gait)
        return ReferenceFrames(**chosen)

"""A clip as a controller: its goals alone, or a tracker's that follows it, through the guard, on whatever body."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import Clip
from servoid.policy.references.clip import ClipReference
from servoid.stack.control.base import BasePolicy
from servoid.stack.control.tracker import Tracker

_NOW = np.array([0])


class ClipPolicy(BasePolicy):
    """Plays a clip once, from the pose that the robot is in, and stays in its last pose; of one robot or of `shape`.

    A `tracker` of the same shape keeps its balance. Without one nothing is balanced: what the robot does between its
    feet and the ground is left to the clip. Raises ConfigError for a clip that leaves the joint ranges.
    """

    def __init__(
        self, robot: Robot, clip: Clip, shape: tuple[int, ...] = (), *, tracker: Tracker | None = None
    ) -> None:
        self._reference, self._tracker = ClipReference(robot, [clip], shape), tracker
        self._entering = np.ones(shape, bool)

    def reset(self, where: Array | None, seeds: Array) -> None:
        everywhere = np.ones_like(self._entering)
        self._entering = self._entering | (everywhere if where is None else where)
        if self._tracker is not None:
            self._tracker.reset(where)

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        if self._entering.any():
            self._reference.play(0, where=self._entering)
            self._reference.enter(np.asarray(applied, dtype=float), self._entering)
            self._entering = np.zeros_like(self._entering)
        if self._tracker is None:
            target = self._reference.frames(_NOW).position[..., 0, :]
        else:
            target = self._tracker(state, applied, self._reference)
        self._reference.advance()
        return target

    @property
    def ended(self) -> bool:
        """Whether the clip is over in every world."""
        return not self._entering.any() and bool(self._reference.ended.all())

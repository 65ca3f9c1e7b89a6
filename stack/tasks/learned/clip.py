"""Imitate a clip (SMP, section 8.6): there is no goal but its manner, which a prior of this clip alone rewards."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import Clip
from servoid.policy.motion.library import find
from servoid.stack.tasks.learned.base import LearnedTask, TaskState

PREFIX = "clip:"  # of the task's name, which a clip's name or file follows
_NEAR = 0.2  # rad off a frame of the clip, root mean square of the joints, at which a pose counts for e^-1
_LOW = 0.75  # of the standing height: a clip whose base goes below does not stay on its feet


class ImitatedClip(LearnedTask):
    """The clip again and again, from its first pose. The policy is told nothing, neither the clip nor the time.

    The reward says how near the pose is to any frame of the clip, and nothing of motion: that is for the prior, in
    training, and for the error by time warping, in a run (task `clip`).
    """

    goal, size, every, run = "stand", 0, (1e6, 1e6), "clip"

    def __init__(self, robot: Robot, clip: str) -> None:
        """`clip`: name in the shipped library, or a file. Raises ConfigError."""
        super().__init__(robot)
        self._clip = find(clip, robot)
        self.name = PREFIX + clip  # type: ignore[misc]  # one class, and a task for each clip
        self._low = bool(self._clip.root_position[:, 2].min() < _LOW * robot.standing_height)

    @property
    def motion(self) -> Clip:
        return self._clip

    @property
    def grounded(self) -> bool:
        return self._low

    def draw(self, rng: np.random.Generator, position: Array) -> Array:
        return np.zeros(0)

    def instruct(self, asked: Array, state: State) -> Instruction:
        return Instruction(velocity=np.zeros((*np.shape(state.yaw), 3)))

    def reward(self, asked: Array, state: TaskState) -> Array:
        off = ((state.joints[:, None] - self._clip.joints) ** 2).mean(-1).min(-1)
        return np.exp(-off / _NEAR**2)

"""Target speed (SMP, section 7): walk straight on, as fast as is asked. The direction stays, and must be kept."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.stack.tasks.learned.base import LearnedTask, TaskState, over_ground

# exp(-0.25 error^2) of a human who runs 6.8 m/s at most: here, of as large a share of the top speed. The paper does not
# print its formula: this is that of AMP, which it follows.
_SHARPNESS = 0.25 * 6.8**2
_SLOWEST = 1.2 / 6.8  # of the top speed


class TargetSpeed(LearnedTask):
    name, goal, size, every, run = "speed", "velocity", 1, (2.0, 5.0), "speed"

    def draw(self, rng: np.random.Generator, position: Array) -> Array:
        return rng.uniform(_SLOWEST, 1.0, 1) * self.robot.walking.forward

    def instruct(self, asked: Array, state: State) -> Instruction:
        return over_ground(np.concatenate([asked, np.zeros_like(asked)], -1), state)

    def reward(self, asked: Array, state: TaskState) -> Array:
        error = state.velocity - np.concatenate([asked, np.zeros_like(asked)], -1)
        return np.exp(-_SHARPNESS * np.sum(error**2, -1) / self.robot.walking.forward**2)

    def steady(self, speed: float) -> Array:
        return np.array([speed])

"""Target location (SMP, section 7): go to a place, and stay there until another is asked."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.geometry import turned
from servoid.stack.tasks.learned.base import LearnedTask, TaskState

# A human runs 10 m, the farthest place, within about 2 of the 5 to 10 s. This robot's top speed is a fifth of the
# scaled one, so places are as much nearer; lengths are those of the body, x 0.275.
_NEAREST, _FARTHEST = 0.15, 1.2  # m
_LENGTH = 0.275  # m: exp(-0.5 (distance / length)^2)
_THERE, _APPROACH = 0.5, 0.5  # of the place, and of the velocity toward it, in what guides
_BRISK, _SHARPNESS = 0.85, 4.0  # exp(-sharpness (brisk - velocity toward it)^2), in shares of the top speed
_NEAR = 0.07  # m from the place where any velocity will do
_FARAWAY = 1e3  # m


class TargetLocation(LearnedTask):
    name, goal, size, every, run = "location", "location", 2, (5.0, 10.0), "location"

    def draw(self, rng: np.random.Generator, position: Array) -> Array:
        distance, bearing = rng.uniform(_NEAREST, _FARTHEST), rng.uniform(-np.pi, np.pi)
        return position + distance * np.array([np.cos(bearing), np.sin(bearing)])

    def instruct(self, asked: Array, state: State) -> Instruction:
        ahead = turned(asked - state.displacement[..., :2], -state.yaw)
        return Instruction(velocity=np.zeros((*ahead.shape[:-1], 3)), goal=ahead)

    def reward(self, asked: Array, state: TaskState) -> Array:
        return np.exp(-0.5 * np.sum((asked - state.position) ** 2, -1) / _LENGTH**2)

    def guided(self, asked: Array, state: TaskState) -> Array:
        """The reward, and as in AMP the velocity toward the place: far from it the reward alone is zero everywhere."""
        way = asked - state.position
        distance = np.linalg.norm(way, axis=-1)
        toward = np.sum(state.velocity * way, -1) / np.maximum(distance, 1e-6) / self.robot.walking.forward
        approach = np.exp(-_SHARPNESS * np.maximum(_BRISK - toward, 0.0) ** 2)
        return _THERE * self.reward(asked, state) + _APPROACH * np.where(distance < _NEAR, 1.0, approach)

    def steady(self, speed: float) -> Array:
        """A place that is never reached: how fast it goes there, the policy decides."""
        return np.array([_FARAWAY, 0.0])

"""Dodgeball (SMP, section 7): get out of the way of a ball that is thrown at the robot. A hit ends the episode."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.geometry import turned
from servoid.stack.tasks.learned.base import LearnedTask, TaskState

# A human has half a second, and 10 m. Steps of this robot go 0.13 m/s to the side and its arms are 0.17 m from its
# middle: what it has to see coming is slower.
_NEAREST, _FARTHEST = 1.0, 2.0  # m
_SLOWEST, _FASTEST = 0.3, 0.6  # m/s
_RADIUS = 0.05  # m of the ball
_WIDTH = 0.17  # m from the base's middle to the arms
_LENGTH, _SPEED = 0.275, 0.524  # m and m/s here for one of a human


class Dodgeball(LearnedTask):
    """The ball flies on over the ground, as it was thrown; it is no body of the simulation, and nothing stops it."""

    name, goal, size, every, run = "dodgeball", "ball", 4, (5.0, 8.0), "dodgeball"

    def draw(self, rng: np.random.Generator, position: Array) -> Array:
        """Place and velocity of the ball."""
        distance, bearing = rng.uniform(_NEAREST, _FARTHEST), rng.uniform(-np.pi, np.pi)
        way = np.array([np.cos(bearing), np.sin(bearing)])
        return np.concatenate([position + distance * way, -rng.uniform(_SLOWEST, _FASTEST) * way])

    def advance(self, asked: Array, seconds: float) -> Array:
        return np.concatenate([asked[:, :2] + seconds * asked[:, 2:], asked[:, 2:]], -1)

    def instruct(self, asked: Array, state: State) -> Instruction:
        place = turned(asked[..., :2] - state.displacement[..., :2], -state.yaw)
        radius = np.full((*place.shape[:-1], 1), _RADIUS)
        ball = np.concatenate([place, radius, turned(asked[..., 2:], -state.yaw)], -1)
        return Instruction(velocity=np.zeros((*place.shape[:-1], 3)), obstacles=ball[..., None, :])

    def ended(self, asked: Array, state: TaskState) -> Array:
        return self._distance(asked, state) < _WIDTH + _RADIUS

    def reward(self, asked: Array, state: TaskState) -> Array:
        far = 1.0 - np.exp(-0.3 * self._distance(asked, state) / _LENGTH)
        still = np.exp(-np.sum(state.velocity**2, -1) / _SPEED**2)
        return (0.9 * far + 0.1 * still) * ~self.ended(asked, state)

    def _distance(self, asked: Array, state: TaskState) -> Array:
        return np.linalg.norm(asked[:, :2] - state.position, axis=-1)

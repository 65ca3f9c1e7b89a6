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
_SEEN = 0.01  # m, deviation of the error with which a ball is first seen
_TWICE = 0.1  # s for which it is seen before anything is known of its velocity
_MARGIN = 0.1  # m from a hit at which it is guided no further
_BRISK, _SHARPNESS = 0.85, 4.0  # exp(-sharpness (brisk - velocity aside)^2), in shares of the top speed
_CLEAR = 0.5  # of what training rewards: being out of the way of what comes


class Dodgeball(LearnedTask):
    """The ball flies on over the ground, as it was thrown; it is no body of the simulation, and nothing stops it.

    Asked are its place and velocity, where it was first seen, and the seconds since. The policy is told no velocity but
    that from where it was first seen to where it is.
    """

    name, goal, size, every, run = "dodgeball", "ball", 7, (5.0, 8.0), "dodgeball"

    def draw(self, rng: np.random.Generator, position: Array) -> Array:
        distance, bearing = rng.uniform(_NEAREST, _FARTHEST), rng.uniform(-np.pi, np.pi)
        way = np.array([np.cos(bearing), np.sin(bearing)])
        place = position + distance * way
        velocity = -rng.uniform(_SLOWEST, _FASTEST) * way
        return np.concatenate([place, velocity, place + rng.normal(0.0, _SEEN, 2), [0.0]])

    def advance(self, asked: Array, seconds: float) -> Array:
        step = np.zeros(self.size)
        step[-1] = seconds
        gone = np.concatenate([seconds * asked[:, 2:4], np.zeros((len(asked), self.size - 2))], -1)
        return asked + gone + step

    def instruct(self, asked: Array, state: State) -> Instruction:
        place = turned(asked[..., :2] - state.displacement[..., :2], -state.yaw)
        since = asked[..., 6:]
        velocity = np.where(since < _TWICE, 0.0, (asked[..., :2] - asked[..., 4:6]) / np.maximum(since, _TWICE))
        radius = np.full((*place.shape[:-1], 1), _RADIUS)
        ball = np.concatenate([place, radius, turned(velocity, -state.yaw)], -1)
        return Instruction(velocity=np.zeros((*place.shape[:-1], 3)), obstacles=ball[..., None, :])

    def ended(self, asked: Array, state: TaskState) -> Array:
        return self._distance(asked, state) < _WIDTH + _RADIUS

    def reward(self, asked: Array, state: TaskState) -> Array:
        far = 1.0 - np.exp(-0.3 * self._distance(asked, state) / _LENGTH)
        still = np.exp(-np.sum(state.velocity**2, -1) / _SPEED**2)
        return (0.9 * far + 0.1 * still) * ~self.ended(asked, state)

    def guided(self, asked: Array, state: TaskState) -> Array:
        """The reward, and how briskly it leaves the way of the ball: the reward tells only once the ball is there."""
        toward, way = asked[:, :2] - state.position, asked[:, 2:4]
        way = way / np.linalg.norm(way, axis=-1, keepdims=True)
        comes = np.sum(toward * way, -1) < 0.0
        side = toward[:, 0] * way[:, 1] - toward[:, 1] * way[:, 0]  # m that the ball passes on its left
        aside = state.velocity[:, 1] * way[:, 0] - state.velocity[:, 0] * way[:, 1]  # m/s away from there
        leaving = np.where(side > 0.0, aside, -aside) / self.robot.walking.forward
        brisk = np.exp(-_SHARPNESS * np.maximum(_BRISK - leaving, 0.0) ** 2)
        clear = np.where(comes & (np.abs(side) < _WIDTH + _RADIUS + _MARGIN), brisk, 1.0)
        return (1.0 - _CLEAR) * self.reward(asked, state) + _CLEAR * clear * ~self.ended(asked, state)

    def _distance(self, asked: Array, state: TaskState) -> Array:
        return np.linalg.norm(asked[:, :2] - state.position, axis=-1)

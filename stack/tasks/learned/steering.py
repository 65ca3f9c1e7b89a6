"""Steering (SMP, section 7): move one way at a speed, and face another."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.stack.tasks.learned.base import LearnedTask, TaskState, over_ground

_SHARPNESS = 0.5 * 5.0**2  # exp(-0.5 error^2) of a human who goes 5 m/s at most: here, of as large a share of the top
_SLOWEST = 0.5 / 5.0  # of the top speed that way


class TargetSteering(LearnedTask):
    """The top speed is that of the direction relative to where it faces: this robot side-steps far slower than it
    walks."""

    name, goal, size, every, run = "steering", "steering", 4, (2.1, 3.7), "steering"

    def draw(self, rng: np.random.Generator, position: Array) -> Array:
        """Velocity over the ground, and the direction to face, a unit vector."""
        way, facing = rng.uniform(-np.pi, np.pi, 2)
        walking, off = self.robot.walking, way - facing
        ahead = walking.forward if np.cos(off) > 0.0 else walking.backward
        top = 1.0 / np.hypot(np.cos(off) / ahead, np.sin(off) / walking.sideways)  # an ellipse through what it can
        speed = top * rng.uniform(_SLOWEST, 1.0)
        return np.array([speed * np.cos(way), speed * np.sin(way), np.cos(facing), np.sin(facing)])

    def instruct(self, asked: Array, state: State) -> Instruction:
        told = over_ground(asked[..., :2], state)
        off = np.arctan2(asked[..., 3], asked[..., 2]) - state.yaw
        told.velocity[..., 2] = (off + np.pi) % (2.0 * np.pi) - np.pi
        return Instruction(told.velocity)

    def reward(self, asked: Array, state: TaskState) -> Array:
        error = np.sum((state.velocity - asked[:, :2]) ** 2, -1) / self.robot.walking.forward**2
        forward = np.sum(state.velocity * asked[:, :2], -1) > 0.0
        faced = np.cos(state.yaw) * asked[:, 2] + np.sin(state.yaw) * asked[:, 3]
        return 0.7 * np.exp(-_SHARPNESS * error) * forward + 0.3 * np.maximum(faced, 0.0)

    def steady(self, speed: float) -> Array:
        return np.array([speed, 0.0, 1.0, 0.0])

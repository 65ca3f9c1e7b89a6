"""Carry (SMP, section 7): pick up a light box from the ground, and bring it to a place."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.world import Scene, SceneObject
from servoid.hw.geometry import headed, turned
from servoid.stack.tasks.learned.base import LearnedTask, TaskState

SIZE, MASS = (0.08, 0.15, 0.10), 0.1  # m along its x, y and z, and kg: 0.15 m fit between the forearms of an OP3
STANDS = SIZE[2] / 2  # m: height of its middle on the ground
_NEAREST, _FARTHEST, _ASIDE = 0.3, 0.6, 0.5  # m from the start to the box, and rad of its bearing, either way
_TURNED = 0.2  # rad by which the side that it is taken by may be turned away, either way
_BROUGHT = (0.4, 1.0)  # m from there to its place
_LENGTH, _REACH, _LIFT = 0.275, 0.2, 0.1  # m of a human's; m from the base to a box at hand; m of a whole lift
_AT_HAND, _HELD, _THERE = 0.2, 0.3, 0.5  # parts of the reward


class Carry(LearnedTask):
    """Asked is the place; the box is a body of the scene, which the policy sees.

    The reward of the paper is not printed: here it is for being at the box, for lifting it, and, while it is lifted,
    for how near its place it is.
    """

    name, goal, size, every, run = "carry", "box", 2, (1e6, 1e6), "carry"

    @property
    def scene(self) -> Scene:
        box = SceneObject("box", (_NEAREST, 0.0), SIZE, MASS)
        return Scene(np.zeros((0, 3)), np.zeros((0, 4)), objects=(box,))

    @property
    def grounded(self) -> bool:
        return True

    def place(self, rng: np.random.Generator) -> Array:
        """Where the box stands as an episode begins `(1, 7)`, in the frame that the robot starts in."""
        distance, bearing = rng.uniform(_NEAREST, _FARTHEST), rng.uniform(-_ASIDE, _ASIDE)
        half = 0.5 * (bearing + rng.uniform(-_TURNED, _TURNED))
        x, y = distance * np.cos(bearing), distance * np.sin(bearing)
        return np.array([[x, y, STANDS, np.cos(half), 0.0, 0.0, np.sin(half)]])

    def draw(self, rng: np.random.Generator, position: Array) -> Array:
        """A place around where a box would be, an average way ahead of the base."""
        ahead = 0.5 * (_NEAREST + _FARTHEST)
        distance, bearing = rng.uniform(*_BROUGHT), rng.uniform(-np.pi, np.pi)
        return position + np.array([ahead + distance * np.cos(bearing), distance * np.sin(bearing)])

    def instruct(self, asked: Array, state: State) -> Instruction:
        ahead = turned(asked - state.displacement[..., :2], -state.yaw)
        return Instruction(velocity=np.zeros((*ahead.shape[:-1], 3)), goal=ahead)

    def reward(self, asked: Array, state: TaskState) -> Array:
        assert state.objects is not None, "a task with a scene sees its objects"
        box = state.objects[:, 0]
        away = np.linalg.norm(box[:, :2] - state.position, axis=-1)
        at_hand = np.exp(-0.5 * (np.maximum(away - _REACH, 0.0) / _LENGTH) ** 2)
        lifted = np.clip((box[:, 2] - STANDS) / _LIFT, 0.0, 1.0)
        there = np.exp(-0.5 * np.sum((box[:, :2] - asked) ** 2, -1) / _LENGTH**2)
        return _AT_HAND * at_hand + lifted * (_HELD + _THERE * there)


def seen_box(pose: Array, state: State) -> Array:
    """A box's pose `(..., 7)` in the odometry frame, as `Instruction.box` has it."""
    place = turned(pose[..., :2] - state.displacement[..., :2], -state.yaw)
    return np.concatenate([place, pose[..., 2:3], headed(pose[..., 3:], -np.asarray(state.yaw))], -1)

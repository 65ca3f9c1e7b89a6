"""What a task policy sees of what it is asked: pure functions of an instruction, the same in training and in a run."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction
from servoid.hw.geometry import rotate
from servoid.hw.robot.description import Walking
from servoid.hw.robot.mirror import Mirror

AHEAD = 1.0  # s of turning that an instruction which gives a yaw rate asks to face
FARTHEST = 1.0  # m: no ball is nearer, where there is none
BESIDE = 1.8  # of the height of the base: as far from the way of a ball, none hits
FACED = 0.4  # of the height of the base, by which a side may be farther that is faced
_AXES = np.eye(3)[[0, 2]]
_HAND, _HELD = 0.66, 0.4  # of the height of the base: a box is taken so far ahead, and is held from that height on
STOPPED = 0.05  # m/s of a ball that goes nowhere, or was not seen for long enough to know
SLOWING = 0.3  # m from a place within which the velocity that leads to it is less than the top speed
TURNING = (0.05, 0.2)  # m from a place: nearer than the first it is not faced, from the second on wholly


@dataclass(frozen=True)
class SeenGoal:
    """A kind of goal: how it is seen `(..., size)`, and in a mirror."""

    name: str
    size: int
    mirror: Mirror
    observe: Callable[[Instruction, Walking], Array]
    velocity: bool = False  # whether it is the velocity that is asked: none of it is to stand
    begins_as: tuple[str, ...] = ()  # goals that its first numbers are like: what sees them can learn to see this
    odometry: bool = True  # whether velocity and height by leg odometry are seen, too: they mean nothing while it lies


def _velocity(instruction: Instruction, walking: Walking) -> Array:
    """Planar velocity in the heading frame `(..., 2)`, in shares of the top speed."""
    asked = instruction.velocity[..., :2] if instruction.ground is None else instruction.ground
    return np.asarray(asked, float) / walking.forward


def _steering(instruction: Instruction, walking: Walking) -> Array:
    """The velocity, and the direction to face, in the heading frame `(..., 4)`: where the ground velocity points, or
    where the yaw rate leads."""
    if instruction.ground is None:
        angle = AHEAD * np.asarray(instruction.velocity[..., 2], float)
    else:
        x, y = instruction.ground[..., 0], instruction.ground[..., 1]
        angle = np.where(np.hypot(x, y) > 1e-6, np.arctan2(y, x), 0.0)
    facing = np.stack([np.cos(angle), np.sin(angle)], -1)
    return np.concatenate([_velocity(instruction, walking), facing], -1)


def _location(instruction: Instruction, walking: Walking) -> Array:
    """The velocity that leads to a place, in shares of the top speed, and the direction to face, in the heading frame
    `(..., 4)`: what `_steering` gives of a velocity, so that what steers can learn to go to places. Here, where it is
    to stand. Raises ConfigError where the task has no place."""
    if instruction.stand:
        return np.broadcast_to([0.0, 0.0, 1.0, 0.0], (*np.shape(instruction.velocity)[:-1], 4))
    if instruction.goal is None:
        raise ConfigError("this policy walks to a place, and the task gives none: run goal, goal-near or goal-far")
    goal = np.asarray(instruction.goal, float)
    distance = np.linalg.norm(goal, axis=-1)
    # The direction of a place underfoot swings wildly.
    angle = np.arctan2(goal[..., 1], goal[..., 0]) * np.interp(distance, TURNING, (0.0, 1.0))
    facing = np.stack([np.cos(angle), np.sin(angle)], -1)
    return np.concatenate([goal / np.maximum(distance, SLOWING)[..., None], facing], -1)


def _ball(instruction: Instruction, walking: Walking) -> Array:
    """The nearest place beside the way of a ball, as `_location` sees one, so that what walks to places can learn to
    get out of the way; then where the ball is [m], and where it goes in shares of the top speed, in the heading frame
    `(..., 8)`. Nothing comes near where it is to stand. Raises ConfigError where the task has no ball."""
    shape = np.shape(instruction.velocity)[:-1]
    if instruction.stand:
        return np.broadcast_to([0.0, 0.0, 1.0, 0.0, FARTHEST, 0.0, 0.0, 0.0], (*shape, 8))
    if instruction.obstacles is None or not np.size(instruction.obstacles):
        raise ConfigError("this policy gets out of a ball's way, and the task has none: run dodgeball")
    things = np.asarray(instruction.obstacles, float)
    distance = np.linalg.norm(things[..., :2], axis=-1)
    nearest = np.take_along_axis(things, np.argmin(distance, -1)[..., None, None], -2)[..., 0, :]
    place, way = nearest[..., :2], nearest[..., 3:5]
    squared = np.sum(way**2, -1, keepdims=True)
    seconds = -np.sum(place * way, -1, keepdims=True) / np.maximum(squared, 1e-9)  # until it is nearest
    passes = place + way * seconds  # there
    aside = np.stack([-way[..., 1], way[..., 0]], -1) / np.sqrt(np.maximum(squared, 1e-9))
    # To the side that is nearer, in which a robot is already, or is faced: it walks ahead far faster than to a side.
    nearer = aside[..., :1] - np.sum(aside * passes, -1, keepdims=True) / (FACED * walking.height)
    aside = np.where(nearer < 0.0, -aside, aside)
    left = np.maximum(BESIDE * walking.height + np.sum(aside * passes, -1, keepdims=True), 0.0)  # m to go
    comes = (squared > STOPPED**2) & (seconds > 0.0)
    beside = _location(Instruction(instruction.velocity, goal=np.where(comes, left * aside, 0.0)), walking)
    return np.concatenate([beside, place, way / walking.forward], -1)


def _box(instruction: Instruction, walking: Walking) -> Array:
    """The way that leads to where a box can be taken or, where it is held, to where it shall be, as `_location` sees
    one; then the place of the box and its x and z axes, and its place to be, in the heading frame `(..., 15)`.
    Raises ConfigError where the task has no box."""
    if instruction.stand:  # where nobody says any more where a box is: as if it were held, where it shall be
        shape, ahead = np.shape(instruction.velocity)[:-1], _HAND * walking.height
        seen = [1.0, 0.0, ahead, 0.0, walking.height, 1.0, 0.0, 0.0, 0.0, 0.0, 1.0, ahead, 0.0]
        return np.broadcast_to([0.0, 0.0, *seen], (*shape, 15))
    if instruction.box is None or instruction.goal is None:
        raise ConfigError("this policy carries a box to a place, and the task gives none: run carry")
    box, goal = np.asarray(instruction.box, float), np.asarray(instruction.goal, float)
    place, (x, z) = box[..., :3], (rotate(box[..., 3:], np.broadcast_to(axis, box[..., :3].shape)) for axis in _AXES)
    x = x * np.where(x[..., :1] < 0.0, -1.0, 1.0)  # either side of it is as good
    held = place[..., 2:] > walking.height * _HELD
    way = np.where(held, goal - place[..., :2], place[..., :2] - _HAND * walking.height * x[..., :2])
    leads = _location(Instruction(instruction.velocity, goal=way), walking)
    return np.concatenate([leads, place, x, z, goal], -1)


def nothing(instruction: Instruction, walking: Walking) -> Array:
    """No numbers `(..., 0)`: what is asked is always the same."""
    return np.zeros((*np.shape(instruction.velocity)[:-1], 0))


GOALS: Mapping[str, SeenGoal] = {
    goal.name: goal
    for goal in (
        SeenGoal("velocity", 2, Mirror.PLANAR, _velocity, velocity=True),
        SeenGoal("steering", 4, Mirror.join(Mirror.PLANAR, Mirror.PLANAR), _steering, velocity=True),
        SeenGoal("location", 4, Mirror.join(Mirror.PLANAR, Mirror.PLANAR), _location),
        SeenGoal("ball", 8, Mirror.join(*[Mirror.PLANAR] * 4), _ball, begins_as=("location", "steering")),
        SeenGoal(
            "box",
            15,
            Mirror.join(Mirror.PLANAR, Mirror.PLANAR, *[Mirror.VECTOR] * 3, Mirror.PLANAR),
            _box,
            begins_as=("location", "steering"),
        ),
        SeenGoal("stand", 0, Mirror(np.zeros(0, int), np.zeros(0, np.float32)), nothing, odometry=False),
    )
}

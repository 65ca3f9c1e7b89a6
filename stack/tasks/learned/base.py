"""What a task is that a policy learns: what is asked, and a reward of 0 to 1. A task is a small file."""

from __future__ import annotations

import math
from abc import ABC, abstractmethod
from dataclasses import dataclass, fields
from typing import TYPE_CHECKING, ClassVar

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.world import Scene
from servoid.hw.geometry import turned
from servoid.hw.robot.description import Robot
from servoid.policy.priors.goals import GOALS, SeenGoal

if TYPE_CHECKING:
    from servoid.policy.motion.clip import Clip
    from servoid.policy.rising.lead import Rising


@dataclass(frozen=True)
class TaskState:
    """What a task's reward may know of `n` worlds: the truth, in the frame that the episode began in."""

    position: Array  # (n, 2) m of the base
    yaw: Array  # (n,) rad
    velocity: Array  # (n, 2) m/s over the ground, averaged over a cycle of the gait: within one, every walk sways
    height: Array  # (n,) m of the base
    gravity: Array  # (n, 3) unit vector, base frame
    angular_velocity: Array  # (n, 3) rad/s, base frame
    joints: Array  # (n, n_joints) rad
    joint_velocity: Array  # (n, n_joints) rad/s
    objects: Array | None = None  # (n, objects, 7): m of the middle, and quaternion; None: the task has no things

    def only(self, rows: slice) -> TaskState:
        """Of these worlds, or ticks."""
        known = (part.name for part in fields(self) if getattr(self, part.name) is not None)
        return TaskState(**{name: getattr(self, name)[rows] for name in known})


class LearnedTask(ABC):
    """A task: `draw` says what is asked, `instruct` tells the policy, `reward` judges."""

    name: ClassVar[str]
    goal: ClassVar[str]  # of `servoid.policy.priors.goals`: what the policy sees
    size: ClassVar[int]  # numbers that are drawn
    every: ClassVar[tuple[float, float]]  # s from one draw to the next
    run: ClassVar[str]  # the task that `servoid run` runs it in
    lies: ClassVar[bool] = False  # whether episodes begin lying, and no fall ends them
    hold: ClassVar[float] = math.inf  # s for which it is `achieved` until an episode is over, as when its time is up

    def __init__(self, robot: Robot) -> None:
        self.robot = robot

    @property
    def seen(self) -> SeenGoal:
        return GOALS[self.goal]

    @property
    def motion(self) -> Clip | None:
        """The clip that it is about, in which episodes begin; None: about none."""
        return None

    @property
    def scene(self) -> Scene | None:
        """What is there beside the robot; None: nothing."""
        return None

    @property
    def grounded(self) -> bool:
        """Whether it goes to the ground, or low: only who tips over has fallen then."""
        return self.lies

    @abstractmethod
    def draw(self, rng: np.random.Generator, position: Array) -> Array:
        """What is asked next `(size,)`, in the frame that the episode began in; the base is at `position` `(2,)`."""

    @abstractmethod
    def instruct(self, asked: Array, state: State) -> Instruction:
        """What the policy is told of `asked` `(n, size)`, by its own estimate."""

    @abstractmethod
    def reward(self, asked: Array, state: TaskState) -> Array:
        """How well it does what is asked `(n,)`, 0 to 1."""

    def guided(self, asked: Array, state: TaskState) -> Array:
        """What training rewards `(n,)`, 0 to 1, where `reward` says too little of the way there."""
        return self.reward(asked, state)

    @property
    def achievable(self) -> bool:
        """Whether its episodes are over once it is `achieved`."""
        return math.isfinite(self.hold)

    def lead(self, n: int) -> Rising | None:
        """What leads the policy in `n` worlds: its targets are around that, not around home, and it sets its pace."""
        return None

    def achieved(self, state: TaskState) -> Array:
        """Where all is done that the task is about `(n,)` bool: never, of one that goes on."""
        return np.zeros(len(state.yaw), bool)

    def advance(self, asked: Array, seconds: float) -> Array:
        """What is asked `(n, size)` so much later [s]: a thing that moves has gone on."""
        return asked

    def ended(self, asked: Array, state: TaskState) -> Array:
        """Where the episode is over, and earns nothing any more `(n,)` bool."""
        return np.zeros(len(asked), bool)

    def steady(self, speed: float) -> Array | None:
        """What asks to walk straight on at `speed` [m/s] `(size,)`; None where the task asks for no speed."""
        return None


def over_ground(velocity: Array, state: State) -> Instruction:
    """To move at `velocity` `(n, 2)` m/s of the odometry frame."""
    ahead = turned(velocity, -state.yaw)
    return Instruction(velocity=np.concatenate([ahead, np.zeros((*ahead.shape[:-1], 1))], -1), ground=ahead)

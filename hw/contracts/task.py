"""What the robot shall do, and the trace that it is judged by."""

from __future__ import annotations

import math
from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass, field
from typing import Any, Protocol

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.operator import CommandSource, Intent
from servoid.hw.contracts.world import Percept, Scene, Start


@dataclass(frozen=True, slots=True)
class Trace:
    """What a run went through, by the estimate or by the truth; one row a tick.

    The truth of a world of several robots says of any of them whether it fell or touched something.
    """

    dt: float
    displacement: Array  # (ticks, 3) m
    yaw: Array  # (ticks,) rad
    velocity: Array  # (ticks, 3) m/s, heading frame
    yaw_rate: Array  # (ticks,) rad/s
    command: Array  # (ticks, 3) instructed velocity
    fallen: bool
    joints: Array | None = None  # (ticks, n_joints) rad
    orientation: Array | None = None  # (ticks, 4) quaternion w x y z of the base
    goal: Array | None = None  # (ticks, 2) m, where the robot saw it; None: where the task has it
    obstacles: Array | None = None  # (ticks, n, 3) m: x, y, radius
    robots: Array | None = None  # (ticks, n, 3) the others: x, y m and heading rad
    objects: Array | None = None  # (ticks, n, 7): x, y, z m of the middle, quaternion w x y z
    touched: bool | None = None  # whether the robot touched an obstacle or another robot; None: it cannot know


@dataclass(frozen=True)
class Episode:
    """What an episode holds, drawn before it begins: data alone. Tasks that draw more extend it."""

    scene: Scene | None = None  # what a simulated world holds beside the robot
    goal: Array | None = None  # (2,) m in the frame that the robot starts in: where it shall go, where that is a point
    pushes: Mapping[int, Array] = field(
        default_factory=dict
    )  # by tick: change of planar velocity (2,) m/s, world frame
    reach: float | None = None  # m from the goal that count as there, where that is judged
    path: Array | None = None  # (n, 2) m to walk along, in the frame that the robot starts in
    start: Start | None = None  # how a simulated body begins, one row; None: standing at home
    seated: bool = False  # the task has the robot sit on a seat: it may be low, but only its feet touch the ground
    told: tuple[str, ...] = ()  # skills that are asked for, by name or in sentences
    low: bool = False  # the task has the robot sit, lie or touch the ground: only its tilt tells a fall then


@dataclass(frozen=True)
class Criterion:
    """One condition of success: a figure of a finished run, and the bounds that it must keep. NaN keeps none."""

    what: str  # the figure in words: "mean velocity error"
    value: float
    unit: str = ""
    least: float = -math.inf
    most: float = math.inf

    @classmethod
    def never(cls, what: str, happened: bool) -> Criterion:
        """Of something that must not happen, in the past tense: "fell"."""
        return cls(what, float(happened), most=0.0)

    @property
    def met(self) -> bool:
        return self.least <= self.value <= self.most

    def __str__(self) -> str:
        """The figure, its bound and, where it is not met, by how much."""
        if self.most == 0.0 and not self.unit:
            return self.what if self.value else f"never {self.what}"
        low = self.value < self.least or math.isinf(self.most)
        bound, word = (self.least, "at least") if low else (self.most, "at most")
        told = f"{self.what} {self._number(self.value)}, {word} {self._number(bound)}"
        if self.met or not math.isfinite(self.value):
            return told
        return f"{told}: {self._number(abs(self.value - bound))} too {'little' if low else 'much'}"

    def _number(self, value: float) -> str:
        return "not measured" if math.isnan(value) else f"{value:.3g} {self.unit}".rstrip()


class Behaviour(Protocol):
    """What is asked of a robot, tick by tick, in one run. It may remember what it asked before.

    `stack.tasks.base.BaseBehaviour` answers all but `instruct`.
    """

    @property
    def teammates(self) -> Sequence[Behaviour]:
        """What is asked of the scene's other robots, in their order."""
        ...

    def percept(self, state: State) -> Percept:
        """What the task itself tells the robot about its surroundings, where nobody sees them."""
        ...

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction: ...

    def done(self, state: State) -> bool:
        """Whether the episode may end before its time."""
        ...

    def take_events(self) -> Sequence[str]:
        """What a person should know of, since the last call."""
        ...

    def lost(self) -> None:
        """Told when its robot has ended, maybe before the others of the scene."""
        ...

    def close(self) -> None:
        """Let go of devices."""
        ...


class Objective(Protocol):
    """The guidance cost. It depends on nothing but its arguments, and can be sent to a planner's process (pickle)."""

    def __call__(self, trajectory: Any, instruction: Instruction) -> Any:
        """Cost `(batch,)` of a predicted trajectory (torch), in the heading frame of now."""
        ...


class Task(Protocol):
    """What the robot shall do, in four parts: scenario, behaviour, objective and scoring.

    Scoring is pure: `run` applies it to the estimate, evaluation to the truth. `episode` is what `scenario` drew.
    """

    name: str
    seconds: float  # length of an episode
    settings: Any  # a frozen dataclass, as the task's file and `--set` say

    @property
    def steered(self) -> bool:
        """Whether a person steers, who needs real time: `steered_behaviour` then takes the place of `behaviour`."""
        ...

    @property
    def performs(self) -> bool:
        """Whether it asks for skills."""
        ...

    @property
    def counts_undone(self) -> Sequence[str]:
        """Metrics that hold of a run that never began, too."""
        ...

    def scenario(self, rng: np.random.Generator) -> Episode:
        """Draw an episode; all that is random in it comes from `rng`. Raises ConfigError where there is none."""
        ...

    def behaviour(self, episode: Any) -> Behaviour:
        """What is asked in a run of this episode. It opens the devices that it needs. Raises ConfigError."""
        ...

    def open_source(self) -> CommandSource:
        """The device that a person steers with, opened, where the task is `steered`. Raises ConfigError where there is
        none."""
        ...

    def steered_behaviour(self, episode: Any, wanted: Callable[[], Intent]) -> Behaviour:
        """What is asked in a run of this episode by a person, who wants now what `wanted` says."""
        ...

    @property
    def objective(self) -> Objective | None:
        """The guidance cost; None where it is zero: planners then need no gradient of it, and no samples."""
        ...

    def criteria(self, trace: Trace, episode: Any) -> Sequence[Criterion]:
        """All that a success needs; empty where the task has a `success` of its own and does not say."""
        ...

    def success(self, trace: Trace, episode: Any) -> bool:
        """Whether every criterion is met."""
        ...

    def metrics(self, trace: Trace, episode: Any) -> dict[str, float]: ...


@dataclass(frozen=True)
class Assignment:
    """A task and the episode of it that a run does, and is judged by."""

    task: Task
    episode: Episode

    def criteria(self, trace: Trace) -> Sequence[Criterion]:
        return self.task.criteria(trace, self.episode)

    def success(self, trace: Trace) -> bool:
        return self.task.success(trace, self.episode)

    def metrics(self, trace: Trace) -> dict[str, float]:
        return self.task.metrics(trace, self.episode)

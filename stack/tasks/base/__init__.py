"""What tasks are made of: settings, and a task whose robot is given a goal at most, that nothing pushes."""

from __future__ import annotations

import math
from collections.abc import Callable, Sequence
from dataclasses import dataclass, field, replace
from typing import Annotated, Any, ClassVar, Literal, TypeVar

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.operator import CommandSource, Intent
from servoid.hw.contracts.task import Behaviour, Criterion, Episode, Objective, Trace
from servoid.hw.contracts.world import Percept
from servoid.hw.robot.description import Robot, shipped_robot
from servoid.hw.setting import Range, Setting, asks, check, rescaled
from servoid.policy.references.gait import gait_of
from servoid.stack.tasks.terms.body import Build
from servoid.stack.tasks.terms.guidance import TotalCost
from servoid.stack.tasks.terms.weights import FreeWeights, Weights

T = TypeVar("T")


@dataclass(frozen=True)
class Settings:
    """Settings of every task; `servoid tasks` shows what is said beside them. Raises ValueError outside a range."""

    seconds: Annotated[float, Setting("length of an episode", "s", above=0)] = 60.0
    cost: Weights = field(default_factory=Weights)  # of the guidance cost

    def __post_init__(self) -> None:
        check(self)

    @property
    def weights(self) -> Weights:
        """Of the guidance cost."""
        return self.cost

    @staticmethod
    def completed(typed: dict[str, str]) -> dict[str, str]:
        """Settings as typed on a command line, with those that follow from them."""
        return typed


def drawn_pushes(rng: np.random.Generator, seconds: float, size: Range, every: float, ticks: int) -> dict[int, Array]:
    """Pushes in random directions `(2,)` m/s by their tick, one each `every` s, which are so many `ticks`. The first
    comes one interval after the start; none where the largest `size` [m/s] is 0."""
    count = math.ceil(seconds / every)
    sizes = rng.uniform(*size, size=count)
    bearing = rng.uniform(-math.pi, math.pi, size=count)
    pushes = sizes[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)
    return {(number + 1) * ticks: push for number, push in enumerate(pushes)} if size[1] > 0.0 else {}


@dataclass(frozen=True)
class FreeSettings(Settings):
    """Settings of a task whose way a planner may find by itself."""

    way: Annotated[
        Literal["script", "cost"],
        Setting("what finds the way: a script, by a velocity that it asks for, or a planner, by the cost `alone`"),
    ] = "script"
    alone: FreeWeights = field(default_factory=FreeWeights)  # of the guidance cost where a planner finds the way

    @property
    def weights(self) -> Weights:
        return self.alone if self.way == "cost" else self.cost

    def asked(self, instruction: Instruction) -> Instruction:
        """The instruction as this way has it: a planner that finds its way is told no sentence but the task's own.

        Its velocity stays, for policies that follow one.
        """
        if self.way == "script" or instruction.stand or instruction.text is not None:
            return instruction
        return replace(instruction, text="")


def beyond(settings: Any, robot: Robot) -> list[str]:
    """A sentence about each speed that a task's settings ask for and the robot cannot reach."""
    top = robot.walking
    limits = {  # that way, and the opposite one
        "forward": (top.forward, top.backward),
        "backward": (top.backward, top.forward),
        "left": (top.sideways, top.sideways),
        "turning": (top.turning, top.turning),
    }
    told = []
    for name, unit, way, speeds in asks(settings):
        for speed in dict.fromkeys(speeds):
            limit = limits[way][speed < 0.0]
            if abs(speed) > limit + 1e-9:
                told.append(f"{name}={speed:g} is more than {robot.name} can: {limit:g} {unit} at most that way")
    return told


def fitted(settings: T, robot: Robot) -> T:
    """Settings that hold for the shipped robot as they hold for `robot`: speeds are the same shares of its top speeds,
    lengths of its height, and times of its gait's cycle. Raises ConfigError."""
    ours, theirs = (
        {
            "forward": (r.walking.forward, r.walking.backward),
            "backward": (r.walking.backward, r.walking.forward),
            "left": (r.walking.sideways, r.walking.sideways),
            "turning": (r.walking.turning, r.walking.turning),
            "height": (r.walking.height,),
            "cycle": (gait_of(r).cycle,),
        }
        for r in (robot, shipped_robot())
    )

    def factor(setting: Setting, value: float) -> float:
        what = setting.of or setting.asks or "height"
        opposite = setting.asks is not None and value < 0.0
        return ours[what][opposite] / theirs[what][opposite]

    try:
        return rescaled(settings, factor)
    except ValueError as error:
        raise ConfigError(f"the task's settings do not fit {robot.name}: {error}") from error


class BaseTask:
    """A task but for what is asked and how a run is judged."""

    name: str = ""
    description: str = ""  # in a line
    settings_type: ClassVar[type[Settings]] = Settings
    steered: ClassVar[bool] = False  # by a person, who needs real time
    performs: bool = False  # skills that are asked for
    counts_undone: ClassVar[tuple[str, ...]] = ()  # metrics that hold of a run that never began, too
    guided_by_velocity_alone: ClassVar[bool] = False  # whether no other term of the cost is about its instructions

    def __init__(self, settings: Any, dt: float, robot: Robot | None = None) -> None:
        """`dt` is the length of a control tick [s]. Raises ConfigError for what cannot be done, or not by `robot`."""
        self.settings, self.dt, self.robot = settings, dt, robot
        self.seconds: float = settings.seconds

    @property
    def top(self) -> Array:
        """Top speeds `(3,)` of the robot, of the shipped one where none was given."""
        return (self.robot or shipped_robot()).walking.scale

    @property
    def build(self) -> Build | None:
        """Of the robot's body, where a term of the cost is about parts of it."""
        return None

    @property
    def cycle(self) -> float:
        """Length of a cycle of the robot's gait [s]: within one, every walk sways."""
        return gait_of(self.robot or shipped_robot()).cycle

    def ticks(self, seconds: float) -> int:
        """The nearest number of ticks, at least one."""
        return max(round(seconds / self.dt), 1)

    def scenario(self, rng: np.random.Generator) -> Episode:
        """Draw an episode; all that is random in it comes from `rng`."""
        return Episode()

    def behaviour(self, episode: Any) -> Behaviour:
        raise NotImplementedError(f"task {self.name} asks for nothing")

    def open_source(self) -> CommandSource:
        raise NotImplementedError(f"nobody steers task {self.name}")

    def steered_behaviour(self, episode: Any, wanted: Callable[[], Intent]) -> Behaviour:
        raise NotImplementedError(f"nobody steers task {self.name}")

    @property
    def objective(self) -> Objective | None:
        """The weighted sum of what an instruction holds (`guidance.TotalCost`); None where it is always zero."""
        weights: Weights = self.settings.weights
        return None if self.guided_by_velocity_alone and not weights.twist else TotalCost(weights, self.build)

    def criteria(self, trace: Trace, episode: Any) -> Sequence[Criterion]:
        """All that a success needs: what a run is told when it fails."""
        return ()

    def success(self, trace: Trace, episode: Any) -> bool:
        """Whether every criterion is met."""
        criteria = self.criteria(trace, episode)
        if not criteria:
            raise NotImplementedError(f"task {self.name} does not say what success is")
        return all(criterion.met for criterion in criteria)

    def metrics(self, trace: Trace, episode: Any) -> dict[str, float]:
        return {}


class BaseBehaviour:
    """Knows the goal of its episode, and goes on until the time is over. Implements Behaviour but for `instruct`."""

    teammates: tuple[Behaviour, ...] = ()

    def __init__(self, episode: Episode) -> None:
        self.episode: Any = episode

    def percept(self, state: State) -> Percept:
        goal = self.episode.goal
        return Percept(source="task", age=0.0, goal=None if goal is None else goal.copy())

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        raise NotImplementedError("a behaviour says what is asked")

    def done(self, state: State) -> bool:
        return False

    def take_events(self) -> Sequence[str]:
        return ()

    def lost(self) -> None:
        """Its robot has ended; nobody else waits for it."""

    def close(self) -> None:
        """There is nothing to let go of."""

"""What all tasks share: settings, and a body that no disturbance touches and that perceives nothing."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated, Any, ClassVar

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Task, Trace
from servoid.hw.contracts.world import Percept, Scene
from servoid.hw.robot.description import Robot
from servoid.stack.tasks.guidance import Trajectory, Weights, total_cost

Range = tuple[float, float]


@dataclass(frozen=True)
class Settings:
    """Settings of every task. The text beside a field is what `servoid tasks` shows."""

    seconds: Annotated[float, "s, length of the episode"]
    cost: Annotated[Weights, "weights of the guidance cost"] = field(default_factory=Weights)

    def __post_init__(self) -> None:
        require_positive(self, "seconds")


class BaseTask:
    """One robot's task over one episode at a time. Implements the Task protocol but for what is asked and `success`."""

    name: str
    description: str
    settings_type: ClassVar[type[Settings]] = Settings
    steered: ClassVar[bool] = False  # by a person, who needs real time
    counts_undone: ClassVar[tuple[str, ...]] = ()  # metrics that hold of a run that never began, too
    goal: Array | None = None  # (2,) m in the frame that the robot starts in, where it shall be in one place
    teammates: tuple[Task, ...] = ()  # the tasks of the scene's other robots

    def __init__(self, settings: Any, dt: float) -> None:
        self.settings = settings
        self.dt = dt
        self.seconds: float = settings.seconds

    @staticmethod
    def complete(settings: dict[str, str]) -> dict[str, str]:
        """Settings as typed, with those that follow from them."""
        return settings

    def steer_by(self, velocities: Array, ended: bool) -> None:
        """Follow a recorded run's velocities `(ticks, 3)`; `ended`: whether with the last one the person ended it."""

    def reset(self, rng: np.random.Generator) -> None:
        """Draw the episode. All randomness of a task comes from `rng`."""

    def lost(self) -> None:
        """The task's robot has ended, maybe before the others of the scene."""

    def close(self) -> None:
        """Let go of devices."""

    def check(self, robot: Robot) -> None:
        """Raise ConfigError where the settings ask for what `robot` cannot do."""

    def scene(self) -> Scene | None:
        """What a simulated world holds in this episode beside the robot; None for nothing."""
        return None

    def percept(self, state: State) -> Percept:
        """What the task itself tells the robot about its surroundings at `state`."""
        return Percept(source="task", age=0.0)

    def disturbance(self, tick: int) -> Array | None:
        """Change of the base's planar velocity `(2,)` m/s in the world frame at `tick`, or None."""
        return None

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        raise NotImplementedError(f"task {self.name} asks for nothing")

    def cost(self, trajectory: Trajectory, instruction: Instruction) -> Any:
        """Guidance cost `(batch,)`: the weighted sum of what the instruction holds (see `guidance.total_cost`)."""
        return total_cost(trajectory, instruction, self.settings.cost)

    @property
    def guides(self) -> bool:
        """Whether its cost can guide a plan; where it is zero, planners need no gradient of it, and no samples."""
        return True

    @property
    def pushes(self) -> bool:
        """Whether `disturbance` may answer with a push, which only a simulated body can be given."""
        return False

    def done(self, state: State) -> bool:
        """Whether the episode may end before its time."""
        return False

    def success(self, trace: Trace) -> bool:
        raise NotImplementedError(f"task {self.name} has no measure of success")

    def metrics(self, trace: Trace) -> dict[str, float]:
        return {}


def require_positive(settings: Any, *keys: str) -> None:
    """Raise ValueError for the first setting that is not positive."""
    for key in keys:
        if getattr(settings, key) <= 0.0:
            raise ValueError(f"{key}: must be positive, not {getattr(settings, key):g}")


def require_ranges(settings: Any, *keys: str) -> None:
    """Raise ValueError for the first range whose low end is above its high end."""
    for key in keys:
        low, high = getattr(settings, key)
        if low > high:
            raise ValueError(f"{key}: upside down: {low:g} is above {high:g}; write low before high")

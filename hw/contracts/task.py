"""What the robot shall do, and the trace that it is judged by."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.world import Percept, Scene


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
    goal: Array | None = None  # (ticks, 2) m, where the robot saw it; None: where the task has it
    obstacles: Array | None = None  # (ticks, n, 3) m: x, y, radius
    robots: Array | None = None  # (ticks, n, 3) the others: x, y m and heading rad
    touched: bool | None = None  # whether the robot touched an obstacle or another robot; None: it cannot know


class Task(Protocol):
    """What the robot shall do. `success` is pure: `run` applies it to the estimate, evaluation to the truth."""

    name: str
    seconds: float
    settings: Any  # a frozen dataclass, as the task's file and `--set` say

    @property
    def steered(self) -> bool:
        """Whether a person steers, who needs real time."""
        ...

    @property
    def guides(self) -> bool:
        """Whether `cost` can guide a plan; where it is zero, planners need no gradient of it, and no samples."""
        ...

    @property
    def pushes(self) -> bool:
        """Whether `disturbance` may answer with a push, which only a simulated body can be given."""
        ...

    @property
    def counts_undone(self) -> tuple[str, ...]:
        """Metrics that hold of a run that never began, too."""
        ...

    @property
    def goal(self) -> Array | None:
        """Where the robot shall be `(2,)` m in the frame that it starts in, where that is one place."""
        ...

    @property
    def teammates(self) -> tuple[Task, ...]:
        """The tasks of the scene's other robots, in their order."""
        ...

    def steer_by(self, velocities: Array, ended: bool) -> None:
        """Follow a recorded run's velocities `(ticks, 3)`; `ended`: whether with the last one the person ended it."""
        ...

    def lost(self) -> None:
        """Its robot has ended, maybe before the others of the scene."""
        ...

    def close(self) -> None:
        """Let go of devices."""
        ...

    def reset(self, rng: np.random.Generator) -> None:
        """Draw the episode's goal, commands and disturbances."""
        ...

    def scene(self) -> Scene | None:
        """What a simulated world holds in this episode beside the robot; None for nothing."""
        ...

    def percept(self, state: State) -> Percept:
        """What the task itself tells the robot about its surroundings, where nobody sees them."""
        ...

    def disturbance(self, tick: int) -> Array | None:
        """Change of the base's planar velocity `(2,)` m/s, world frame, to be applied by a simulated body; or None."""
        ...

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction: ...

    def cost(self, trajectory: Any, instruction: Instruction) -> Any:
        """Guidance cost `(batch,)` of a predicted trajectory (torch), in the heading frame of now."""
        ...

    def done(self, state: State) -> bool: ...

    def success(self, trace: Trace) -> bool: ...

    def metrics(self, trace: Trace) -> dict[str, float]: ...

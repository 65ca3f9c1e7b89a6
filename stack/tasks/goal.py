"""Walk to a point and stand there."""

from __future__ import annotations

import math
from collections import deque
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Trace
from servoid.hw.contracts.world import Percept, Scene
from servoid.hw.geometry import to_heading
from servoid.policy.text.captions import twist_of
from servoid.stack.navigation.go_to_point import Approach, approach
from servoid.stack.tasks import metrics as measures
from servoid.stack.tasks.base import BaseTask, Range, Settings, require_positive, require_ranges
from servoid.stack.tasks.sentences import require_words, understood


@dataclass(frozen=True)
class GoalSettings(Settings):
    distance: Annotated[Range, "m to the goal, one value or low:high; its bearing is drawn from the full circle"] = (
        0.5,
        1.5,
    )
    x: Annotated[float | None, "m ahead of the start: fixes the goal (y is 0 unless given)"] = None
    y: Annotated[float | None, "m to the left of the start: fixes the goal (x is 0 unless given)"] = None
    radius: Annotated[float, "m from the goal that count as reached"] = 0.1
    stand: Annotated[bool, "whether it must also stand there, or coming there is enough"] = True
    seen: Annotated[bool, "whether the robot sees the goal, as by a camera, or goes by its odometry alone"] = False
    arrive: Annotated[float, "m from the goal at which to stop"] = 0.05
    leave: Annotated[float, "m from the goal at which to start again"] = 0.1
    text: Annotated[str | None, "a sentence on how to go there, beside the cost (else one that names the velocity)"] = (
        None
    )
    approach: Annotated[Approach, "speed profile"] = field(default_factory=Approach)

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "radius", "arrive")
        require_ranges(self, "distance")
        if self.distance[0] < 0.0:
            raise ValueError("distance: must not be negative")
        if self.leave < self.arrive:
            raise ValueError(f"leave: {self.leave:g} must not be below arrive ({self.arrive:g})")


class Goal(BaseTask):
    name = "goal"
    description = "walk to a point, drawn anywhere around the robot, and stand there"
    settings_type = GoalSettings

    def __init__(self, settings: GoalSettings, dt: float) -> None:
        """Raises ConfigError for a text that names no motion, or none that goes anywhere."""
        super().__init__(settings, dt)
        if settings.text is not None and not twist_of(understood("text", settings.text)).any():
            raise ConfigError(f"--set text={settings.text}: a robot that stands reaches no goal; say how to walk")

    @staticmethod
    def complete(settings: dict[str, str]) -> dict[str, str]:
        """Raises ConfigError for a text without a word."""
        require_words(settings, "text")
        return settings

    def reset(self, rng: np.random.Generator) -> None:
        """Draw the goal, fixed in the odometry frame."""
        distance, bearing = rng.uniform(*self.settings.distance), rng.uniform(-math.pi, math.pi)
        self.goal: Array = distance * np.array([math.cos(bearing), math.sin(bearing)])
        if self.settings.x is not None or self.settings.y is not None:
            self.goal = np.array([self.settings.x or 0.0, self.settings.y or 0.0])
        self._stopped = False
        self._standing = _Standing()

    def scene(self) -> Scene | None:
        """The goal as a mark on the floor, where it shall be seen."""
        return Scene(np.zeros((0, 3)), np.zeros((0, 4)), self.goal.copy()) if self.settings.seen else None

    def percept(self, state: State) -> Percept:
        return Percept(source="task", age=0.0, goal=self.goal.copy())

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        """The velocity of the speed profile; zero once arrived, until the robot has drifted off."""
        ahead = to_heading(self.goal if percept.goal is None else percept.goal, state)
        distance = float(np.linalg.norm(ahead))
        self._stopped = distance <= (self.settings.leave if self._stopped else self.settings.arrive)
        velocity = np.zeros(3) if self._stopped else approach(ahead, self.settings.approach)
        text = None if self._stopped else self.settings.text  # whoever has arrived is told to stand
        return Instruction(velocity=velocity, goal=ahead, text=text)

    def done(self, state: State) -> bool:
        """Arrived, and standing for 1 s where that is asked."""
        standing = self._standing.update(state) or not self.settings.stand
        return standing and self._stopped

    def success(self, trace: Trace) -> bool:
        """Within the radius of the goal, and standing there, at the end. The trace is in the odometry frame."""
        there = not trace.fallen and bool(self._distances(trace)[-1] <= self.settings.radius)
        return there and (not self.settings.stand or measures.standing(trace))

    def metrics(self, trace: Trace) -> dict[str, float]:
        distances = self._distances(trace)
        outside = np.flatnonzero(distances > self.settings.radius)
        arrival = int(outside[-1]) + 1 if len(outside) else 0  # the tick from which it stayed within the radius
        return {
            "final_distance_m": float(distances[-1]),
            "path_m": measures.path_length(trace, step=0.48),
            "seconds_to_goal": arrival * trace.dt if arrival < len(trace.displacement) else float("nan"),
        }

    def _distances(self, trace: Trace) -> Array:
        """Distance to the goal [m] at each tick; infinite for a run that never started."""
        if len(trace.displacement) == 0:
            return np.array([np.inf])
        return np.linalg.norm(trace.displacement[:, :2] - (self.goal if trace.goal is None else trace.goal), axis=1)


class _Standing:
    """Whether the estimated planar speed, smoothed over 0.2 s, has been below 0.05 m/s for 1 s."""

    def __init__(self) -> None:
        self._recent: deque[tuple[int, Array]] = deque()
        self._since_ns: int | None = None

    def update(self, state: State) -> bool:
        now = state.time_ns
        if not self._recent or self._recent[-1][0] != now:
            self._recent.append((now, state.velocity[:2]))
        while now - self._recent[0][0] >= measures.SMOOTHING * 1e9:
            self._recent.popleft()
        speed = float(np.linalg.norm(np.mean([velocity for _, velocity in self._recent], axis=0)))
        if not speed < measures.STANDING_SPEED:  # a NaN is not standing
            self._since_ns = None
        elif self._since_ns is None:
            self._since_ns = now
        return self._since_ns is not None and now - self._since_ns >= measures.STANDING_TIME * 1e9

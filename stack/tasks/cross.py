"""Several robots cross a circle, each to the place opposite of where it started, without touching another."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Trace
from servoid.hw.contracts.world import Percept, Scene
from servoid.hw.geometry import to_heading, turned
from servoid.stack.navigation.collision_avoidance import Motion, Passing, way
from servoid.stack.navigation.go_to_point import Approach, approach
from servoid.stack.tasks import metrics as measures
from servoid.stack.tasks.base import BaseTask, Settings, require_positive

_FEWEST, _MOST = 2, 4
_ROOM = 0.7  # m between neighbours at the start and at the end: none is in the way of another who stands


@dataclass(frozen=True)
class CrossSettings(Settings):
    robots: Annotated[int, "how many, 2 to 4"] = 3
    circle: Annotated[float, "m, radius of the circle that they start on"] = 1.1
    spread: Annotated[float, "rad that a start is drawn to either side of its even place on the circle"] = 0.2
    body: Annotated[float, "m from the middle of a robot to its side"] = 0.15
    radius: Annotated[float, "m from the goal that count as reached"] = 0.14
    approach: Annotated[Approach, "speed profile"] = field(default_factory=Approach)
    passing: Annotated[Passing, "choice of the way, for the asked velocity"] = field(default_factory=Passing)

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "circle", "body", "radius")
        if not _FEWEST <= self.robots <= _MOST:
            raise ValueError(f"robots: {self.robots} cannot cross: give {_FEWEST} to {_MOST}")
        gap = 2.0 * math.pi / self.robots - 2.0 * self.spread
        if self.spread < 0.0 or gap <= 0.0:
            raise ValueError(f"spread: {self.spread:g} rad: give 0 to less than {math.pi / self.robots:.3f}")
        least = 0.5 * _ROOM / math.sin(0.5 * gap)
        if self.circle < least:
            raise ValueError(
                f"circle: {self.circle:g} m is too small a radius for {self.robots} robots, {_ROOM:g} m apart:"
                f" give {math.ceil(100 * least) / 100:g} or more"
            )


class Cross(BaseTask):
    """The task of one of the robots, in whose frame it starts at the origin and its goal lies straight ahead.

    The first robot's task draws the episode and holds the tasks of the others. They tell it by radio that they are
    there, or lost; where they are, it sees.
    """

    name = "cross"
    description = "cross a circle together with other robots, to the opposite side, without touching one"
    settings_type = CrossSettings
    teammates: tuple[Cross, ...] = ()  # of the first robot's task: those of the other robots

    def __init__(self, settings: CrossSettings, dt: float) -> None:
        super().__init__(settings, dt)
        self._begin()

    def _begin(self) -> None:
        self.goal: Array = np.array([2.0 * self.settings.circle, 0.0])
        self.arrived = self.ended = False
        self._bearing = 0.0  # rad in the odometry frame, of the way that was chosen
        self._motion = Motion(self.settings.passing.window, self.dt)
        self._others: Array = np.zeros((0, 5))  # rows of the scene's robots

    def reset(self, rng: np.random.Generator) -> None:
        """Draw where on the circle the others start."""
        s = self.settings
        self._begin()
        even = 2.0 * math.pi * np.arange(1, s.robots) / s.robots
        angles = math.pi + even + rng.uniform(-s.spread, s.spread, s.robots - 1)  # from the middle; its own is pi
        rim = s.circle * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        middle = np.array([s.circle, 0.0])
        self._others = np.column_stack([middle + rim, angles - math.pi, middle - rim])
        self.teammates = tuple(Cross(s, self.dt) for _ in range(s.robots - 1))

    def scene(self) -> Scene:
        return Scene(np.zeros((0, 3)), np.zeros((0, 4)), self.goal, self._others)

    def percept(self, state: State) -> Percept:
        """The goal and nobody else: the others stand in a simulated world alone."""
        return Percept(source="task", age=0.0, goal=self.goal.copy())

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        """The goal, the others as obstacles that move, and a velocity past them; standing, once arrived."""
        s = self.settings
        goal = to_heading(self.goal if percept.goal is None else percept.goal, state)
        robots = np.zeros((0, 3)) if percept.robots is None else percept.robots
        near = to_heading(robots[:, :2], state)
        velocity = turned(self._motion.update(robots[:, :2]), -state.yaw)
        self.arrived = bool(np.linalg.norm(goal) <= (1.0 if self.arrived else 0.7) * s.radius)
        if self.arrived:
            return Instruction(velocity=np.zeros(3), goal=goal)
        bearing = way(
            goal, np.column_stack([near, velocity]), s.approach.speed, self._bearing - float(state.yaw), s.passing
        )
        self._bearing = bearing + float(state.yaw)
        target = np.linalg.norm(goal) * np.array([math.cos(bearing), math.sin(bearing)])
        obstacles = np.column_stack([near, np.full(len(near), s.body), velocity])
        return Instruction(velocity=approach(target, s.approach), goal=goal, obstacles=obstacles)

    def done(self, state: State) -> bool:
        """For the first robot, when it and all others have arrived, or cannot any more. The others stand meanwhile."""
        return bool(self.teammates) and self.arrived and all(other.arrived or other.ended for other in self.teammates)

    def lost(self) -> None:
        self.ended = True

    def success(self, trace: Trace) -> bool:
        """None ever fell or touched another, and all are within the radius of their goals at the end."""
        return not (trace.fallen or self._touched(trace)) and self._arrived(trace) == self.settings.robots

    def metrics(self, trace: Trace) -> dict[str, float]:
        there = self._arrived(trace)
        return {
            "arrived": float(there),
            "apart_m": self._apart(trace),
            "touched": float(self._touched(trace)),
            "path_m": measures.path_length(trace, step=0.48),
            "seconds_to_cross": len(trace.yaw) * trace.dt if there == self.settings.robots else float("nan"),
        }

    def _arrived(self, trace: Trace) -> int:
        """How many robots are within the radius of their goals at the end."""
        if len(trace.displacement) == 0 or trace.robots is None:
            return 0
        places = np.vstack([trace.displacement[-1, :2], trace.robots[-1, :, :2]])
        own = self.goal if trace.goal is None else trace.goal[-1]
        apart = np.linalg.norm(places - np.vstack([own, self._others[:, 3:]]), axis=1)
        return int((apart <= self.settings.radius).sum())

    def _apart(self, trace: Trace) -> float:
        """Least distance [m] between the bases of two robots; NaN for a run that never started."""
        if trace.robots is None or not trace.robots.size:
            return float("nan")
        places = np.concatenate([trace.displacement[:, None, :2], trace.robots[..., :2]], axis=1)
        first, second = np.triu_indices(places.shape[1], 1)
        return float(np.linalg.norm(places[:, first] - places[:, second], axis=-1).min())

    def _touched(self, trace: Trace) -> bool:
        """Robots that cannot feel it believe so where two are so near that one's middle is in the other's body."""
        return self._apart(trace) < self.settings.body if trace.touched is None else trace.touched

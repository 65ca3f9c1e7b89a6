"""Several robots cross a circle, each to the place opposite of where it started, without touching another."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Criterion, Episode, Trace
from servoid.hw.contracts.world import Percept, Scene
from servoid.hw.geometry import to_heading, turned
from servoid.hw.setting import Setting
from servoid.stack.navigation.collision_avoidance import AvoidanceSettings, MeanVelocity, bearing_past
from servoid.stack.navigation.go_to_point import SpeedProfile, go_to_point
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, FreeSettings
from servoid.stack.tasks.terms import metrics as measures

_ROOM = 0.7  # m between neighbours at the start and at the end: none is in the way of another who stands


@dataclass(frozen=True)
class CrossSettings(FreeSettings):
    robots: Annotated[int, Setting("number of robots", least=2, most=4)] = 3
    circle: Annotated[float, Setting("radius of the circle on which they start", "m", above=0)] = 1.1
    spread: Annotated[float, Setting("how far a start may be from its even place on the circle", "rad", least=0)] = 0.2
    body: Annotated[float, Setting("distance from the middle of a robot to its side", "m", above=0, of="height")] = 0.15
    radius: Annotated[float, Setting("distance from the goal that counts as reached", "m", above=0)] = 0.14
    approach: SpeedProfile = field(default_factory=SpeedProfile)
    passing: AvoidanceSettings = field(default_factory=AvoidanceSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        gap = 2.0 * math.pi / self.robots - 2.0 * self.spread
        if gap <= 0.0:
            raise ValueError(f"spread: {self.spread:g} rad: give 0 to less than {math.pi / self.robots:.3f}")
        least = 0.5 * _ROOM / math.sin(0.5 * gap)
        if self.circle < least:
            raise ValueError(
                f"circle: {self.circle:g} m is too small a radius for {self.robots} robots, {_ROOM:g} m apart:"
                f" give {math.ceil(100 * least) / 100:g} or more"
            )


class Cross(BaseTask):
    """Each robot starts at the origin of its own frame, and its goal lies straight ahead."""

    name = "cross"
    description = "cross a circle with other robots, to the opposite side, untouched"
    settings_type = CrossSettings

    def scenario(self, rng: np.random.Generator) -> Episode:
        """Draw where on the circle the others start."""
        s = self.settings
        even = 2.0 * math.pi * np.arange(1, s.robots) / s.robots
        angles = math.pi + even + rng.uniform(-s.spread, s.spread, s.robots - 1)  # from the middle; its own is pi
        rim = s.circle * np.stack([np.cos(angles), np.sin(angles)], axis=-1)
        middle, goal = np.array([s.circle, 0.0]), np.array([2.0 * s.circle, 0.0])
        others = np.column_stack([middle + rim, angles - math.pi, middle - rim])
        return Episode(Scene(np.zeros((0, 3)), np.zeros((0, 4)), goal, others), goal, reach=s.radius)

    def behaviour(self, episode: Episode) -> BaseBehaviour:
        """The first robot's, which knows those of the others."""
        teammates = tuple(_CrossOver(episode, self.settings, self.dt) for _ in range(self.settings.robots - 1))
        return _CrossOver(episode, self.settings, self.dt, teammates)

    def criteria(self, trace: Trace, episode: Episode) -> list[Criterion]:
        """None ever fell or touched another, and all are within the radius of their goals at the end."""
        arrived = self._arrived(trace, episode)
        return [
            Criterion.never("fell", trace.fallen),
            Criterion.never("touched another robot", self._touched(trace)),
            Criterion("arrived", arrived, "robots", least=self.settings.robots),
        ]

    def metrics(self, trace: Trace, episode: Episode) -> dict[str, float]:
        there = self._arrived(trace, episode)
        return {
            "arrived": float(there),
            "apart_m": _apart(trace),
            "touched": float(self._touched(trace)),
            "path_m": measures.path_length(trace, self.cycle),
            "seconds_to_cross": len(trace.yaw) * trace.dt if there == self.settings.robots else float("nan"),
        }

    def _arrived(self, trace: Trace, episode: Episode) -> int:
        """How many robots are within the radius of their goals at the end."""
        if len(trace.displacement) == 0 or trace.robots is None:
            return 0
        assert episode.goal is not None
        assert episode.scene is not None
        assert episode.scene.robots is not None
        places = np.vstack([trace.displacement[-1, :2], trace.robots[-1, :, :2]])
        own = episode.goal if trace.goal is None else trace.goal[-1]
        apart = np.linalg.norm(places - np.vstack([own, episode.scene.robots[:, 3:]]), axis=1)
        return int((apart <= self.settings.radius).sum())

    def _touched(self, trace: Trace) -> bool:
        """Robots that cannot feel it believe so where two are so near that one's middle is in the other's body."""
        return _apart(trace) < self.settings.body if trace.touched is None else trace.touched


def _apart(trace: Trace) -> float:
    """Least distance [m] between the bases of two robots; NaN for a run that never started."""
    if trace.robots is None or not trace.robots.size:
        return float("nan")
    places = np.concatenate([trace.displacement[:, None, :2], trace.robots[..., :2]], axis=1)
    first, second = np.triu_indices(places.shape[1], 1)
    return float(np.linalg.norm(places[:, first] - places[:, second], axis=-1).min())


class _CrossOver(BaseBehaviour):
    """Teammates tell each other by radio that they have arrived, or are lost; where they are, each sees.

    Its own percept has the goal and nobody else: the others stand in a simulated world alone.
    """

    def __init__(
        self, episode: Episode, settings: CrossSettings, dt: float, teammates: tuple[_CrossOver, ...] = ()
    ) -> None:
        super().__init__(episode)
        self.teammates = self._mates = teammates
        self.arrived = self.ended = False
        self._settings = settings
        self._bearing = 0.0  # rad in the odometry frame, of the way that was chosen
        self._motion = MeanVelocity(settings.passing.window, dt)

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        """The goal, the others as obstacles that move, and a velocity past them; standing, once arrived."""
        s = self._settings
        goal = to_heading(self.episode.goal if percept.goal is None else percept.goal, state)
        robots = np.zeros((0, 3)) if percept.robots is None else percept.robots
        near = to_heading(robots[:, :2], state)
        velocity = turned(self._motion.update(robots[:, :2]), -state.yaw)
        self.arrived = bool(np.linalg.norm(goal) <= (1.0 if self.arrived else 0.7) * s.radius)
        if self.arrived:
            return Instruction(velocity=np.zeros(3), goal=goal, stand=True)
        bearing = bearing_past(
            goal, np.column_stack([near, velocity]), s.approach.speed, self._bearing - float(state.yaw), s.passing
        )
        self._bearing = bearing + float(state.yaw)
        target = np.linalg.norm(goal) * np.array([math.cos(bearing), math.sin(bearing)])
        obstacles = np.column_stack([near, np.full(len(near), s.body), velocity])
        return s.asked(Instruction(velocity=go_to_point(target, s.approach), goal=goal, obstacles=obstacles))

    def done(self, state: State) -> bool:
        """For the first robot, when it and all others have arrived, or cannot any more. The others stand meanwhile."""
        return bool(self.teammates) and self.arrived and all(mate.arrived or mate.ended for mate in self._mates)

    def lost(self) -> None:
        self.ended = True

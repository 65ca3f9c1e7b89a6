"""Walk under a bar to a point behind it, without touching it: the robot must be lower than it walks."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Criterion, Episode, Trace
from servoid.hw.contracts.world import Percept, Scene, SceneObject
from servoid.hw.geometry import to_heading
from servoid.hw.robot.description import Robot, shipped_robot
from servoid.hw.setting import Range, Setting
from servoid.stack.navigation.go_to_point import SpeedProfile, go_to_point
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, FreeSettings
from servoid.stack.tasks.body import build_of, lowest_top
from servoid.stack.tasks.terms import metrics as measures
from servoid.stack.tasks.terms.body import Build

_THICK = 0.02  # m


@dataclass(frozen=True)
class CrouchUnderSettings(FreeSettings):
    height: Annotated[Range, Setting("height of the bar's lower edge above the ground", "m", above=0, of="height")] = (
        0.47,
        0.48,
    )
    ahead: Annotated[float, Setting("distance of the bar from the start", "m", above=0, of="height")] = 0.5
    behind: Annotated[float, Setting("distance of the goal behind the bar", "m", above=0, of="height")] = 0.5
    width: Annotated[float, Setting("length of the bar, across the way", "m", above=0, of="height")] = 1.2
    radius: Annotated[float, Setting("distance from the goal that counts as reached", "m", above=0)] = 0.14
    approach: SpeedProfile = field(default_factory=SpeedProfile)


class CrouchUnder(BaseTask):
    name = "crouch-under"
    description = "walk under a bar that is lower than the robot"
    settings_type = CrouchUnderSettings

    def __init__(self, settings: CrouchUnderSettings, dt: float, robot: Robot | None = None) -> None:
        """Raises ConfigError for a bar that the robot cannot get under."""
        super().__init__(settings, dt, robot)
        who = robot or shipped_robot()
        self._build = build_of(who)
        lowest = lowest_top(who, self._build)
        if settings.height[0] < lowest:
            raise ConfigError(
                f"crouch-under: height={settings.height[0]:g} m is lower than {who.name} can crouch: its highest part "
                f"comes down to {lowest:.3f} m at best"
            )

    @property
    def build(self) -> Build:
        return self._build

    def scenario(self, rng: np.random.Generator) -> Episode:
        """Draw how high the bar lies."""
        s = self.settings
        bar = SceneObject("bar", (s.ahead, 0.0), (_THICK, s.width, _THICK), lift=rng.uniform(*s.height))
        goal = np.array([s.ahead + s.behind, 0.0])
        return Episode(Scene(np.zeros((0, 3)), np.zeros((0, 4)), goal, objects=(bar,)), goal, reach=s.radius)

    def behaviour(self, episode: Episode) -> BaseBehaviour:
        return _PassUnder(episode, self.settings)

    def criteria(self, trace: Trace, episode: Episode) -> list[Criterion]:
        """Never fallen, the bar never touched, and at the goal, which lies behind it; not past an end of the bar."""
        return [
            Criterion.never("fell", trace.fallen),
            Criterion.never("touched the bar", self._touched(trace)),
            Criterion.never("went around the bar", self._around(trace)),
            Criterion("final distance from the goal", self._left(trace, episode), "m", most=self.settings.radius),
        ]

    def metrics(self, trace: Trace, episode: Episode) -> dict[str, float]:
        beneath = self._beneath(trace)
        return {
            "final_distance_m": self._left(trace, episode),
            "touched": float(self._touched(trace)),
            "base_beneath_m": float(trace.displacement[beneath, 2].max()) if beneath.any() else math.nan,
            "path_m": measures.path_length(trace, self.cycle),
            "seconds_to_goal": len(trace.yaw) * trace.dt if self.success(trace, episode) else math.nan,
        }

    def _from_bar(self, trace: Trace) -> Array:
        """Places `(ticks, 2)` m as the bar has them: how far behind it, and how far along it from its middle."""
        if trace.objects is None:
            return np.zeros((0, 2))
        w, _, _, z = np.moveaxis(trace.objects[:, 0, 3:], -1, 0)
        yaw = 2.0 * np.arctan2(z, w)
        x, y = np.moveaxis(trace.displacement[:, :2] - trace.objects[:, 0, :2], -1, 0)
        return np.stack([np.cos(yaw) * x + np.sin(yaw) * y, np.cos(yaw) * y - np.sin(yaw) * x], -1)

    def _beneath(self, trace: Trace) -> Array:
        """Whether the robot's middle was right beneath the bar `(ticks,)`."""
        beneath: Array = np.abs(self._from_bar(trace)[:, 0]) < _THICK
        return beneath

    def _touched(self, trace: Trace) -> bool:
        """Whether the robot touched the bar. One that cannot feel it believes so where its top was beneath too high."""
        if trace.touched is not None or trace.objects is None:
            return bool(trace.touched)
        edges = trace.objects[:, 0, 2] - _THICK / 2
        over = trace.displacement[:, 2] + self._build.top > edges
        return bool((over & self._beneath(trace)).any())

    def _around(self, trace: Trace) -> bool:
        """Whether the robot came to the other side beyond an end of the bar."""
        behind, along = np.moveaxis(self._from_bar(trace), -1, 0)
        crossed = np.flatnonzero(np.diff(np.sign(behind)) != 0.0)
        return bool((np.abs(along[crossed]) > self.settings.width / 2).any())

    def _left(self, trace: Trace, episode: Episode) -> float:
        if len(trace.displacement) == 0:
            return math.inf
        goal = episode.goal if trace.goal is None else trace.goal[-1]
        return float(np.linalg.norm(trace.displacement[-1, :2] - goal))


class _PassUnder(BaseBehaviour):
    def __init__(self, episode: Episode, settings: CrouchUnderSettings) -> None:
        super().__init__(episode)
        self._settings, self._seen = settings, episode.goal
        (self._bar,) = self.episode.scene.objects

    def percept(self, state: State) -> Percept:
        """Where bar and goal were put: nobody sees them."""
        pose = np.array([[*self._bar.place, self._bar.height, 1.0, 0.0, 0.0, 0.0]])
        return Percept(source="task", age=0.0, goal=self.episode.goal.copy(), objects=pose)

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        """The goal and the bar, and a velocity straight ahead to the goal: no script makes a robot lower."""
        self._seen = self.episode.goal if percept.goal is None else percept.goal
        goal = to_heading(self._seen, state)
        bars = None
        if percept.objects is not None and len(percept.objects):
            x, y, z, w, _, _, turn = percept.objects[0]
            direction = 2.0 * math.atan2(turn, w) + math.pi / 2 - float(state.yaw)
            lower = z - self._bar.size[2] / 2
            bars = np.array([[*to_heading(np.array([x, y]), state), direction, self._bar.size[1] / 2, lower]])
        s = self._settings
        return s.asked(Instruction(velocity=go_to_point(goal, s.approach), goal=goal, bars=bars))

    def done(self, state: State) -> bool:
        """At the goal, as the robot sees it."""
        return bool(np.linalg.norm(self._seen - state.displacement[:2]) <= 0.7 * self._settings.radius)

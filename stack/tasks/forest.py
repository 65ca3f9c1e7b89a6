"""Walk through a forest of pillars to a goal behind it, without touching one."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Criterion, Episode, Trace
from servoid.hw.contracts.world import Percept, Scene
from servoid.hw.geometry import to_heading
from servoid.hw.robot.description import Robot
from servoid.hw.setting import Setting
from servoid.stack.navigation.go_to_point import SpeedProfile, go_to_point
from servoid.stack.navigation.potential_field import FieldSettings, PotentialField
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, FreeSettings
from servoid.stack.tasks.terms import metrics as measures

Pillar = tuple[float, float, float]
_RENEWAL = 0.5  # s after which a field is computed anew where pillars are seen elsewhere: odometry drifts
_TRIES = 10_000  # draws of a pillar's place before the area counts as full


@dataclass(frozen=True)
class ForestSettings(FreeSettings):
    pillars: Annotated[int, Setting("number of pillars", least=0)] = 15
    pillar_radius: Annotated[float, Setting("radius of a pillar", "m", above=0)] = 0.05
    width: Annotated[float, Setting("width of the forest, across the robot's way", "m", above=0)] = 2.2
    depth: Annotated[float, Setting("depth of the forest, along the robot's way", "m", above=0)] = 2.5
    clearing: Annotated[float, Setting("radius around start and goal without a pillar", "m", least=0)] = 0.35
    spacing: Annotated[float, Setting("least distance between the middles of two pillars", "m", least=0)] = 0.3
    places: Annotated[
        tuple[Pillar, ...], Setting("x,y,radius:x,y,radius:... of each pillar: fixes the forest", "m")
    ] = ()
    x: Annotated[float | None, Setting("ahead of the start: fixes the goal (else behind the forest)", "m")] = None
    y: Annotated[float | None, Setting("to the left of the start: fixes the goal", "m")] = None
    radius: Annotated[float, Setting("distance from the goal that counts as reached", "m", above=0)] = 0.14
    approach: SpeedProfile = field(default_factory=SpeedProfile)
    field: FieldSettings = field(default_factory=FieldSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        if any(radius <= 0.0 for _, _, radius in self.places):
            raise ValueError("places: the radius of a pillar must be positive")


class Forest(BaseTask):
    name = "forest"
    description = "walk through a forest of pillars to a goal behind it"
    settings_type = ForestSettings

    def __init__(self, settings: ForestSettings, dt: float, robot: Robot | None = None) -> None:
        """Raises ConfigError for a start or a goal inside a pillar."""
        super().__init__(settings, dt, robot)
        self._require_room("start", np.zeros(2), "move the pillar")
        if settings.x is not None or settings.y is not None:
            self._require_room("goal", np.array([settings.x or 0.0, settings.y or 0.0]), "move the goal")

    def _require_room(self, what: str, place: Array, remedy: str) -> None:
        """Raise ConfigError where a pillar of the settings leaves the robot no room at `place` `(2,)` m."""
        body = self.settings.field.body
        for x, y, radius in self.settings.places:
            if np.hypot(*(place - [x, y])) < radius + body:
                raise ConfigError(
                    f"forest: the {what} at x={place[0]:g}, y={place[1]:g} is inside the pillar at x={x:g}, y={y:g},"
                    f" or too near for a robot of {body:g} m to each side: {remedy}"
                )

    def scenario(self, rng: np.random.Generator) -> Episode:
        """Draw goal and pillars. Raises ConfigError when so many do not fit, or one stands where the goal is drawn."""
        s = self.settings
        goal = np.array([s.depth + 2 * s.clearing, rng.uniform(-s.width / 4, s.width / 4)])
        if s.x is not None or s.y is not None:
            goal = np.array([s.x or 0.0, s.y or 0.0])
        self._require_room("goal", goal, "move the pillar, or fix the goal by x and y")
        pillars = np.array(s.places, dtype=float).reshape(-1, 3)
        scene = Scene(pillars if len(pillars) else self._draw(rng, goal), np.zeros((0, 4)), goal)
        return Episode(scene, goal, reach=s.radius)

    def _draw(self, rng: np.random.Generator, goal: Array) -> Array:
        """Pillars `(n, 3)` m."""
        s, found = self.settings, np.zeros((0, 3))
        room = max(s.clearing, s.pillar_radius + s.field.body)  # whatever the clearing, the robot fits in at both ends
        for _ in range(_TRIES):
            if len(found) == s.pillars:
                return found
            place = np.array([s.clearing + rng.uniform(0.0, s.depth), rng.uniform(-s.width / 2, s.width / 2)])
            ends = np.linalg.norm(np.stack([place, place - goal]), axis=1)
            if ends.min() > room and (np.linalg.norm(found[:, :2] - place, axis=1) > s.spacing).all():
                found = np.vstack([found, [*place, s.pillar_radius]])
        raise ConfigError(
            f"forest: {s.pillars} pillars {s.spacing:g} m apart do not fit into {s.width:g} by {s.depth:g} m:"
            " set fewer pillars or less spacing"
        )

    def behaviour(self, episode: Episode) -> BaseBehaviour:
        return _GoBetween(episode, self.settings, self.ticks(_RENEWAL))

    def criteria(self, trace: Trace, episode: Episode) -> list[Criterion]:
        """Never fallen, no pillar touched, and within the radius of the goal at the end."""
        distance = _final_distance(trace, episode)
        return [
            Criterion.never("fell", trace.fallen),
            Criterion.never("touched a pillar", measures.touched(trace)),
            Criterion("final distance from the goal", distance, "m", most=self.settings.radius),
        ]

    def metrics(self, trace: Trace, episode: Episode) -> dict[str, float]:
        return {
            "final_distance_m": _final_distance(trace, episode),
            "clearance_m": measures.clearance(trace),
            "touched": float(measures.touched(trace)),
            "path_m": measures.path_length(trace, self.cycle),
            "seconds_to_goal": len(trace.yaw) * trace.dt if self.success(trace, episode) else float("nan"),
        }


def _final_distance(trace: Trace, episode: Episode) -> float:
    """Distance from the goal at the end [m]; infinite for a run that never started."""
    if len(trace.displacement) == 0:
        return float("inf")
    return float(np.linalg.norm(trace.displacement[-1, :2] - (episode.goal if trace.goal is None else trace.goal[-1])))


class _GoBetween(BaseBehaviour):
    def __init__(self, episode: Episode, settings: ForestSettings, renewal: int) -> None:
        """`renewal`: ticks after which the field is computed anew where the pillars are seen elsewhere."""
        super().__init__(episode)
        self._settings, self._renewal = settings, renewal
        self._field: PotentialField | None = None
        self._seen: Array = self.episode.goal

    def percept(self, state: State) -> Percept:
        episode = self.episode
        return Percept(source="task", age=0.0, goal=episode.goal.copy(), obstacles=episode.scene.pillars.copy())

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        """The goal and the pillars, and a velocity down their potential field."""
        self._seen = self.episode.goal if percept.goal is None else percept.goal
        pillars = self.episode.scene.pillars if percept.obstacles is None else percept.obstacles
        place = state.displacement[:2]
        if self._field is None or (tick % self._renewal == 0 and not self._field.fits(self._seen, pillars, place)):
            self._field = PotentialField(self._seen, pillars, place, self._settings.field)
        way = to_heading(self._field.downhill(place), state)
        goal = to_heading(self._seen, state)
        far = way * np.linalg.norm(goal) / max(float(np.linalg.norm(way)), 1e-9)  # to slow down at the goal alone
        s = self._settings
        return s.asked(
            Instruction(
                velocity=go_to_point(far, s.approach),
                goal=goal,
                obstacles=np.pad(to_heading(pillars, state), ((0, 0), (0, 2))),  # they stand
                distances=self._field.seen_from(state) if s.weights.way or s.weights.along else None,
            )
        )

    def done(self, state: State) -> bool:
        """At the goal, as the robot sees it."""
        return bool(np.linalg.norm(self._seen - state.displacement[:2]) <= 0.7 * self._settings.radius)

"""Walk through a forest of pillars to a goal behind it, without touching one."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Trace
from servoid.hw.contracts.world import Percept, Scene
from servoid.hw.geometry import to_heading
from servoid.stack.navigation.go_to_point import Approach, approach
from servoid.stack.navigation.potential_field import Field, FieldSettings
from servoid.stack.tasks import metrics as measures
from servoid.stack.tasks.base import BaseTask, Settings, require_positive

Pillar = tuple[float, float, float]
_RENEWAL = 0.5  # s after which a field is drawn anew where pillars are seen elsewhere: odometry drifts
_TRIES = 10_000  # draws of a pillar's place before the area counts as full


@dataclass(frozen=True)
class ForestSettings(Settings):
    pillars: Annotated[int, "how many"] = 15
    pillar_radius: Annotated[float, "m"] = 0.05
    width: Annotated[float, "m, across the robot's way"] = 2.2
    depth: Annotated[float, "m, along it"] = 2.5
    clearing: Annotated[float, "m around start and goal without a pillar"] = 0.35
    spacing: Annotated[float, "m at least between the middles of two pillars"] = 0.3
    places: Annotated[tuple[Pillar, ...], "x,y,radius:x,y,radius:... m of each pillar: fixes the forest"] = ()
    x: Annotated[float | None, "m ahead of the start: fixes the goal (else drawn behind the forest)"] = None
    y: Annotated[float | None, "m to the left of the start: fixes the goal"] = None
    radius: Annotated[float, "m from the goal that count as reached"] = 0.14
    approach: Annotated[Approach, "speed profile"] = field(default_factory=Approach)
    field: Annotated[FieldSettings, "potential field, for the asked velocity"] = field(default_factory=FieldSettings)

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "pillar_radius", "width", "depth", "radius")
        if self.pillars < 0 or self.spacing < 0.0 or self.clearing < 0.0:
            raise ValueError("pillars, spacing and clearing: must not be negative")
        if any(radius <= 0.0 for _, _, radius in self.places):
            raise ValueError("places: the radius of a pillar must be positive")


class Forest(BaseTask):
    name = "forest"
    description = "walk through a forest of pillars to a goal behind it"
    settings_type = ForestSettings

    def __init__(self, settings: ForestSettings, dt: float) -> None:
        """Raises ConfigError for a start or a goal inside a pillar."""
        super().__init__(settings, dt)
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

    def reset(self, rng: np.random.Generator) -> None:
        """Draw goal and pillars. Raises ConfigError when so many do not fit, or one stands where the goal is drawn."""
        s = self.settings
        self.goal: Array = np.array([s.depth + 2 * s.clearing, rng.uniform(-s.width / 4, s.width / 4)])
        if s.x is not None or s.y is not None:
            self.goal = np.array([s.x or 0.0, s.y or 0.0])
        self._require_room("goal", self.goal, "move the pillar, or fix the goal by x and y")
        self.pillars: Array = np.array(s.places, dtype=float).reshape(-1, 3)
        if not len(self.pillars):
            self.pillars = self._draw(rng)
        self._field: Field | None = None

    def _draw(self, rng: np.random.Generator) -> Array:
        s, found = self.settings, np.zeros((0, 3))
        room = max(s.clearing, s.pillar_radius + s.field.body)  # whatever the clearing, the robot fits in at both ends
        for _ in range(_TRIES):
            if len(found) == s.pillars:
                return found
            place = np.array([s.clearing + rng.uniform(0.0, s.depth), rng.uniform(-s.width / 2, s.width / 2)])
            ends = np.linalg.norm(np.stack([place, place - self.goal]), axis=1)
            if ends.min() > room and (np.linalg.norm(found[:, :2] - place, axis=1) > s.spacing).all():
                found = np.vstack([found, [*place, s.pillar_radius]])
        raise ConfigError(
            f"forest: {s.pillars} pillars {s.spacing:g} m apart do not fit into {s.width:g} by {s.depth:g} m:"
            " set fewer pillars or less spacing"
        )

    def scene(self) -> Scene:
        return Scene(self.pillars, np.zeros((0, 4)), self.goal)

    def percept(self, state: State) -> Percept:
        return Percept(source="task", age=0.0, goal=self.goal.copy(), obstacles=self.pillars.copy())

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        """The goal and the pillars, and a velocity down their potential field."""
        self._seen = self.goal if percept.goal is None else percept.goal
        pillars = self.pillars if percept.obstacles is None else percept.obstacles
        place = state.displacement[:2]
        renew = self._field is None or (
            tick % max(round(_RENEWAL / self.dt), 1) == 0 and not self._field.fits(self._seen, pillars, place)
        )
        if renew:
            self._field = Field(self._seen, pillars, place, self.settings.field)
        assert self._field is not None
        way = to_heading(self._field.downhill(place), state)
        goal = to_heading(self._seen, state)
        far = way * np.linalg.norm(goal) / max(float(np.linalg.norm(way)), 1e-9)  # to slow down at the goal alone
        return Instruction(
            velocity=approach(far, self.settings.approach),
            goal=goal,
            obstacles=np.pad(to_heading(pillars, state), ((0, 0), (0, 2))),  # they stand
        )

    def done(self, state: State) -> bool:
        """At the goal, as the robot sees it."""
        return bool(np.linalg.norm(self._seen - state.displacement[:2]) <= 0.7 * self.settings.radius)

    def success(self, trace: Trace) -> bool:
        """Never fallen, no pillar touched, and within the radius of the goal at the end."""
        return not (trace.fallen or measures.touched(trace)) and self._distance(trace) <= self.settings.radius

    def metrics(self, trace: Trace) -> dict[str, float]:
        return {
            "final_distance_m": self._distance(trace),
            "clearance_m": measures.clearance(trace),
            "touched": float(measures.touched(trace)),
            "path_m": measures.path_length(trace, step=0.48),
            "seconds_to_goal": len(trace.yaw) * trace.dt if self.success(trace) else float("nan"),
        }

    def _distance(self, trace: Trace) -> float:
        """Distance from the goal at the end [m]; infinite for a run that never started."""
        if len(trace.displacement) == 0:
            return float("inf")
        goal = self.goal if trace.goal is None else trace.goal[-1]
        return float(np.linalg.norm(trace.displacement[-1, :2] - goal))

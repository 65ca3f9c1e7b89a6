"""Get away from a sphere that rolls toward the robot, without being touched."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Criterion, Episode, Trace
from servoid.hw.contracts.world import Percept, Scene
from servoid.hw.geometry import to_heading
from servoid.hw.setting import Setting
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, FreeSettings
from servoid.stack.tasks.terms import metrics as measures


@dataclass(frozen=True)
class ObstacleSettings(FreeSettings):
    distance: Annotated[float, Setting("distance of the sphere's middle at the start", "m", above=0)] = 0.55
    bearing: Annotated[
        float | None, Setting("bearing of the sphere at the start, to the left (none: drawn)", "rad")
    ] = None
    radius: Annotated[float, Setting("radius of the sphere", "m", above=0)] = 0.1
    sphere_speed: Annotated[float, Setting("speed at which the sphere rolls toward the robot", "m/s", least=0)] = 0.08
    escape: Annotated[float, Setting("distance from the sphere's middle that counts as escaped", "m", above=0)] = 0.825
    speed: Annotated[float, Setting("fastest step forward", "m/s", above=0, asks="forward")] = 0.25
    reverse: Annotated[float, Setting("fastest step backward", "m/s", asks="backward")] = 0.0
    lateral: Annotated[float, Setting("fastest step to either side", "m/s", asks="left")] = 0.0
    yaw_rate: Annotated[float, Setting("fastest turn", "rad/s", asks="turning")] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.distance <= self.radius:
            raise ValueError(f"distance: {self.distance:g} m puts the robot inside the sphere ({self.radius:g} m)")
        if self.sphere_speed >= self.speed:
            raise ValueError(f"sphere_speed: {self.sphere_speed:g} must be below speed ({self.speed:g}), to escape it")


class Obstacle(BaseTask):
    name = "obstacle"
    description = "get away from a sphere that pursues the robot"
    settings_type = ObstacleSettings

    def scenario(self, rng: np.random.Generator) -> Episode:
        """Draw where the sphere comes from."""
        s, bearing = self.settings, rng.uniform(-math.pi, math.pi)
        if s.bearing is not None:
            bearing = s.bearing
        place = s.distance * np.array([math.cos(bearing), math.sin(bearing)])
        return Episode(Scene(np.zeros((0, 3)), np.array([[*place, s.radius, s.sphere_speed]])))

    def behaviour(self, episode: Episode) -> BaseBehaviour:
        return _GetAway(episode, self.settings, self.dt)

    def criteria(self, trace: Trace, episode: Episode) -> list[Criterion]:
        """Never fallen, never touched, and far from the sphere at the end."""
        s, distance = self.settings, measures.clearance(trace, slice(-1, None)) + self.settings.radius
        return [
            Criterion.never("fell", trace.fallen),
            Criterion.never("touched the sphere", measures.touched(trace)),
            Criterion("final distance from the sphere", distance, "m", least=s.escape),
        ]

    def metrics(self, trace: Trace, episode: Episode) -> dict[str, float]:
        return {
            "clearance_m": measures.clearance(trace),
            "final_distance_m": measures.clearance(trace, slice(-1, None)) + self.settings.radius,
            "touched": float(measures.touched(trace)),
            "seconds_to_escape": len(trace.yaw) * trace.dt if self.success(trace, episode) else float("nan"),
        }


class _GetAway(BaseBehaviour):
    def __init__(self, episode: Episode, settings: ObstacleSettings, dt: float) -> None:
        super().__init__(episode)
        self._settings, self._dt, self._distance = settings, dt, settings.distance
        self._sphere = self.episode.scene.spheres[0, :2]

    def percept(self, state: State) -> Percept:
        """The sphere, which rolls on by a tick: on a robot without eyes it is only imagined."""
        place, s = self._sphere.copy(), self._settings
        way = state.displacement[:2] - place
        self._sphere = place + s.sphere_speed * self._dt * way / max(float(np.linalg.norm(way)), 1e-9)
        return Percept(source="task", age=0.0, obstacles=np.array([[*place, s.radius]]))

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        """Away from the sphere: turning to walk ahead, and meanwhile stepping as far as the settings allow."""
        s = self._settings
        if percept.obstacles is None or not len(percept.obstacles):
            return Instruction(velocity=np.zeros(3))
        obstacles = to_heading(percept.obstacles, state)
        nearest = obstacles[np.argmin(np.linalg.norm(obstacles[:, :2], axis=1)), :2]
        self._distance = float(np.linalg.norm(nearest))
        bearing = math.atan2(-nearest[1], -nearest[0])
        velocity = np.array(
            [
                min(max(s.speed * math.cos(bearing), -s.reverse), s.speed),
                min(max(s.speed * math.sin(bearing), -s.lateral), s.lateral),
                min(max(1.5 * bearing, -s.yaw_rate), s.yaw_rate),
            ]
        )
        rolling = -s.sphere_speed * obstacles[:, :2] / np.linalg.norm(obstacles[:, :2], axis=1, keepdims=True)
        return s.asked(Instruction(velocity=velocity, obstacles=np.concatenate([obstacles, rolling], -1)))

    def done(self, state: State) -> bool:
        """Escaped, as the robot sees it, with something to spare."""
        return self._distance >= self._settings.escape + 0.01

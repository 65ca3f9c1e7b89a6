"""Get away from a sphere that rolls toward the robot, without being touched."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Trace
from servoid.hw.contracts.world import Percept, Scene
from servoid.hw.geometry import to_heading
from servoid.stack.tasks import metrics as measures
from servoid.stack.tasks.base import BaseTask, Settings, require_positive


@dataclass(frozen=True)
class ObstacleSettings(Settings):
    distance: Annotated[float, "m from the robot to the middle of the sphere at the start"] = 0.55
    bearing: Annotated[float | None, "rad to the left, of the sphere at the start (drawn unless given)"] = None
    radius: Annotated[float, "m, of the sphere"] = 0.1
    sphere_speed: Annotated[float, "m/s at which it rolls straight toward the robot"] = 0.08
    escape: Annotated[float, "m from the middle of the sphere that count as escaped"] = 0.825
    speed: Annotated[float, "m/s forward at most, of the asked velocity"] = 0.25
    reverse: Annotated[float, "m/s backward at most"] = 0.0
    lateral: Annotated[float, "m/s to either side at most"] = 0.0
    yaw_rate: Annotated[float, "rad/s at most"] = 1.0

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "distance", "radius", "escape", "speed")
        if self.distance <= self.radius:
            raise ValueError(f"distance: {self.distance:g} m puts the robot inside the sphere ({self.radius:g} m)")
        if not 0.0 <= self.sphere_speed < self.speed:
            raise ValueError(f"sphere_speed: {self.sphere_speed:g} must be below speed ({self.speed:g}), to escape it")


class Obstacle(BaseTask):
    name = "obstacle"
    description = "get away from a sphere that pursues the robot"
    settings_type = ObstacleSettings

    def reset(self, rng: np.random.Generator) -> None:
        """Draw where the sphere comes from."""
        bearing = rng.uniform(-math.pi, math.pi)
        if self.settings.bearing is not None:
            bearing = self.settings.bearing
        self._sphere: Array = self.settings.distance * np.array([math.cos(bearing), math.sin(bearing)])
        self._distance = self.settings.distance

    def scene(self) -> Scene:
        sphere = np.array([[*self._sphere, self.settings.radius, self.settings.sphere_speed]])
        return Scene(np.zeros((0, 3)), sphere)

    def percept(self, state: State) -> Percept:
        """The sphere, which rolls on by a tick: on a robot without eyes it is only imagined."""
        place = self._sphere.copy()
        way = state.displacement[:2] - place
        self._sphere = place + self.settings.sphere_speed * self.dt * way / max(float(np.linalg.norm(way)), 1e-9)
        return Percept(source="task", age=0.0, obstacles=np.array([[*place, self.settings.radius]]))

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        """Away from the sphere: turning to walk ahead, and meanwhile stepping as far as the settings allow."""
        s = self.settings
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
        return Instruction(velocity=velocity, obstacles=np.concatenate([obstacles, rolling], -1))

    def done(self, state: State) -> bool:
        """Escaped, as the robot sees it, with something to spare."""
        return self._distance >= self.settings.escape + 0.01

    def success(self, trace: Trace) -> bool:
        """Never fallen, never touched, and far from the sphere at the end."""
        if trace.fallen or measures.touched(trace) or trace.obstacles is None or not len(trace.obstacles):
            return False
        return measures.clearance(trace, slice(-1, None)) + self.settings.radius >= self.settings.escape

    def metrics(self, trace: Trace) -> dict[str, float]:
        return {
            "clearance_m": measures.clearance(trace),
            "final_distance_m": measures.clearance(trace, slice(-1, None)) + self.settings.radius,
            "touched": float(measures.touched(trace)),
            "seconds_to_escape": len(trace.yaw) * trace.dt if self.success(trace) else float("nan"),
        }

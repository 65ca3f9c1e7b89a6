"""Walk along a path over the ground: an S, a circle, or a line through points."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Criterion, Episode, Trace
from servoid.hw.contracts.world import Percept, Scene
from servoid.hw.geometry import to_heading
from servoid.hw.setting import Setting
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, FreeSettings
from servoid.stack.tasks.terms import metrics as measures

Point = tuple[float, float]
_SPACING = 0.01  # m between the points of a path


@dataclass(frozen=True)
class PathSettings(FreeSettings):
    shape: Annotated[Literal["s", "circle", "waypoints"], Setting("s, circle or waypoints")] = "s"
    radius: Annotated[float, Setting("radius of the arcs of an S, or of the circle", "m", above=0)] = 0.4
    waypoints: Annotated[tuple[Point, ...], Setting("points after the start: x,y:x,y:...", "m")] = (
        (0.8, 0.0),
        (0.8, 0.8),
    )
    speed: Annotated[float, Setting("speed along the path", "m/s", above=0, asks="forward")] = 0.15
    lookahead: Annotated[float, Setting("how far along the path the robot heads", "m", above=0)] = 0.15
    horizon: Annotated[int, Setting("how far ahead a planner is given places on the path", "ticks", above=0)] = 64
    yaw_rate: Annotated[float, Setting("fastest turn", "rad/s", above=0, asks="turning")] = 0.8
    seen: Annotated[bool, Setting("whether the robot sees the path's end, as by a camera: else odometry tells it")] = (
        True
    )
    tolerance: Annotated[
        float, Setting("largest mean distance from the path, and from its end, of a success", "m", above=0)
    ] = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.shape == "waypoints":
            points = np.vstack([np.zeros(2), np.reshape(self.waypoints, (-1, 2))])
            if len(points) < 2 or (np.linalg.norm(np.diff(points, axis=0), axis=1) < _SPACING).any():
                raise ValueError("waypoints: give one or more, each away from the one before (the start is 0,0)")


@dataclass(frozen=True, kw_only=True)
class Course(Episode):
    path: Array  # (n, 2) m, a centimetre apart, from the robot on


class Path(BaseTask):
    name = "path"
    description = "walk along a path: an S, a circle, or a line through points"
    settings_type = PathSettings

    def scenario(self, rng: np.random.Generator) -> Course:
        """Lay out the path, which starts at the robot; its end is a mark on the floor, where it shall be seen."""
        points = _layout(self.settings)
        scene = Scene(np.zeros((0, 3)), np.zeros((0, 4)), points[-1].copy()) if self.settings.seen else None
        return Course(scene, points[-1], path=points, reach=self.settings.tolerance)

    def behaviour(self, episode: Course) -> BaseBehaviour:
        return _Follow(episode, self.settings, self.dt)

    def criteria(self, trace: Trace, episode: Course) -> list[Criterion]:
        """Never fallen, near the path on average, and at its end by way of it. The trace is in the odometry frame."""
        error, end, left = self._errors(trace, episode.path)
        tolerance = self.settings.tolerance
        return [
            Criterion.never("fell", trace.fallen),
            Criterion("mean distance from the path", error, "m", most=tolerance),
            Criterion("final distance from its end", end, "m", most=tolerance),
            Criterion("way left on it", left, "m", most=tolerance),
        ]

    def metrics(self, trace: Trace, episode: Course) -> dict[str, float]:
        error, end, left = self._errors(trace, episode.path)
        return {
            "path_error_m": error,
            "final_distance_m": end,
            "left_m": left,
            "length_m": _SPACING * (len(episode.path) - 1),
            "path_m": measures.path_length(trace, self.cycle),
        }

    def _errors(self, trace: Trace, points: Array) -> tuple[float, float, float]:
        """Mean distance from the nearest point of the path; at the end, distance from its end, and what is left [m]."""
        if len(trace.displacement) == 0:
            return float("inf"), float("inf"), float("inf")
        places = trace.displacement[:, :2]
        if trace.goal is not None:
            places = places - (trace.goal - points[-1])
        nearest = [float(np.linalg.norm(points - place, axis=1).min()) for place in places]
        at = 0
        for place in places:
            at = _walked(at, points, place, self.settings.lookahead)
        left = _SPACING * (len(points) - 1 - at)
        return float(np.mean(nearest)), float(np.linalg.norm(places[-1] - points[-1])), left


class _Follow(BaseBehaviour):
    def __init__(self, episode: Course, settings: PathSettings, dt: float) -> None:
        super().__init__(episode)
        self._settings, self._dt = settings, dt
        self._at = 0  # index of the point that the robot has come to

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        """Where to be at the next ticks, and a velocity toward a point ahead on the path (pure pursuit)."""
        s, points = self._settings, self.episode.path
        if percept.goal is not None:
            points = points + (percept.goal - points[-1])  # odometry has drifted by so much
        self._at = _walked(self._at, points, state.displacement[:2], s.lookahead)
        along = self._at + np.round(s.speed * self._dt * np.arange(1, s.horizon + 1) / _SPACING).astype(int)
        path = to_heading(points[np.minimum(along, len(points) - 1)], state)
        target = to_heading(points[min(self._at + round(s.lookahead / _SPACING), len(points) - 1)], state)
        distance, bearing = float(np.linalg.norm(target)), math.atan2(target[1], target[0])
        forward = s.speed * max(math.cos(bearing), 0.0)
        turn = 2.0 * s.speed * math.sin(bearing) / max(distance, 0.05)
        if abs(bearing) > 0.5 * math.pi:
            turn = math.copysign(s.yaw_rate, bearing)
        turn = min(max(turn, -s.yaw_rate), s.yaw_rate)
        velocity = np.array([forward, 0.0, turn])
        return s.asked(Instruction(velocity=velocity, goal=to_heading(points[-1], state), path=path))

    def done(self, state: State) -> bool:
        """At the end of the path."""
        return self._at >= len(self.episode.path) - max(round(0.4 * self._settings.tolerance / _SPACING), 1)


def _walked(at: int, points: Array, place: Array, lookahead: float) -> int:
    """Index of the point that a robot at `place` `(2,)` m has come to, from that with index `at`.

    It is the nearest one of the stretch that comes next: a path may cross itself, or end where it began.
    """
    stretch = points[at : at + round(2.0 * lookahead / _SPACING) + 1]
    return at + int(np.argmin(np.linalg.norm(stretch - place, axis=1)))


def _layout(settings: PathSettings) -> Array:
    """Points `(n, 2)` m, a centimetre apart; the path begins at the origin, an S or a circle along x."""
    if settings.shape == "waypoints":
        corners = np.vstack([np.zeros(2), np.reshape(settings.waypoints, (-1, 2))])
        legs = np.linalg.norm(np.diff(corners, axis=0), axis=1)
        at = np.concatenate([[0.0], np.cumsum(legs)])
        along = np.linspace(0.0, at[-1], max(round(at[-1] / _SPACING), 1) + 1)
        return np.stack([np.interp(along, at, corners[:, axis]) for axis in (0, 1)], axis=-1)
    radius = settings.radius
    whole = 2.0 * math.pi if settings.shape == "circle" else math.pi
    turn = np.linspace(0.0, whole, max(round(whole * radius / _SPACING), 2) + 1)
    arc = radius * np.stack([np.sin(turn), 1.0 - np.cos(turn)], axis=-1)
    # The second half of an S turns the other way: it is the first one, turned by half a turn about its end.
    return arc if settings.shape == "circle" else np.vstack([arc, 2.0 * arc[-1] - arc[-2::-1]])

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
from servoid.hw.contracts.task import Criterion, Episode, Trace
from servoid.hw.contracts.world import Percept, Scene
from servoid.hw.geometry import to_heading
from servoid.hw.robot.description import Robot
from servoid.hw.setting import Range, Setting
from servoid.policy.text.captions import MOTIONS
from servoid.stack.navigation.go_to_point import SpeedProfile, go_to_point
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, FreeSettings
from servoid.stack.tasks.terms import metrics as measures
from servoid.stack.tasks.text import understood


@dataclass(frozen=True)
class GoalSettings(FreeSettings):
    distance: Annotated[Range, Setting("distance of the goal; it is drawn at any bearing", "m", least=0)] = (0.5, 1.5)
    x: Annotated[float | None, Setting("ahead of the start: fixes the goal (y is 0 unless given)", "m")] = None
    y: Annotated[float | None, Setting("to the left of the start: fixes the goal (x is 0 unless given)", "m")] = None
    radius: Annotated[float, Setting("distance from the goal that counts as reached", "m", above=0)] = 0.1
    stand: Annotated[bool, Setting("whether it must also stand there: else coming there is enough")] = True
    seen: Annotated[bool, Setting("whether the robot sees the goal, as by a camera: else odometry tells it")] = False
    arrive: Annotated[float, Setting("distance from the goal at which to stop", "m", above=0)] = 0.05
    leave: Annotated[float, Setting("distance from the goal at which to start again", "m")] = 0.1
    text: Annotated[str | None, Setting("sentence on how to walk (none: one that names the velocity)")] = None
    approach: SpeedProfile = field(default_factory=SpeedProfile)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.leave < self.arrive:
            raise ValueError(f"leave: {self.leave:g} must not be below arrive ({self.arrive:g})")


class Goal(BaseTask):
    name = "goal"
    description = "walk to a point, drawn anywhere around the robot, and stand there"
    settings_type = GoalSettings

    def __init__(self, settings: GoalSettings, dt: float, robot: Robot | None = None) -> None:
        """Raises ConfigError for a text that names no motion, or none that goes anywhere."""
        super().__init__(settings, dt, robot)
        if settings.text is not None and not any(MOTIONS[understood("text", settings.text)].typical):
            raise ConfigError(f"--set text={settings.text}: a robot that stands reaches no goal; say how to walk")

    def scenario(self, rng: np.random.Generator) -> Episode:
        """Draw the goal, fixed in the odometry frame; a mark on the floor, where it shall be seen."""
        s = self.settings
        distance, bearing = rng.uniform(*s.distance), rng.uniform(-math.pi, math.pi)
        goal = distance * np.array([math.cos(bearing), math.sin(bearing)])
        if s.x is not None or s.y is not None:
            goal = np.array([s.x or 0.0, s.y or 0.0])
        scene = Scene(np.zeros((0, 3)), np.zeros((0, 4)), goal.copy()) if s.seen else None
        return Episode(scene, goal, reach=s.radius)

    def behaviour(self, episode: Episode) -> BaseBehaviour:
        return _GoAndStand(episode, self.settings)

    def criteria(self, trace: Trace, episode: Episode) -> list[Criterion]:
        """Within the radius of the goal, and standing there, at the end. The trace is in the odometry frame."""
        distance = float(_distances(trace, episode)[-1])
        found = [
            Criterion.never("fell", trace.fallen),
            Criterion("final distance from the goal", distance, "m", most=self.settings.radius),
        ]
        if self.settings.stand:
            found.append(Criterion.never("moved in the last second", not measures.standing(trace)))
        return found

    def metrics(self, trace: Trace, episode: Episode) -> dict[str, float]:
        distances = _distances(trace, episode)
        outside = np.flatnonzero(distances > self.settings.radius)
        arrival = int(outside[-1]) + 1 if len(outside) else 0  # the tick from which it stayed within the radius
        return {
            "final_distance_m": float(distances[-1]),
            "path_m": measures.path_length(trace, self.cycle),
            "seconds_to_goal": arrival * trace.dt if arrival < len(trace.displacement) else float("nan"),
        }


def _distances(trace: Trace, episode: Episode) -> Array:
    """Distance to the goal [m] at each tick; infinite for a run that never started."""
    if len(trace.displacement) == 0:
        return np.array([np.inf])
    return np.linalg.norm(trace.displacement[:, :2] - (episode.goal if trace.goal is None else trace.goal), axis=1)


class _GoAndStand(BaseBehaviour):
    def __init__(self, episode: Episode, settings: GoalSettings) -> None:
        super().__init__(episode)
        self._settings, self._stopped, self._standing = settings, False, _Standing()

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        """The velocity of the speed profile; zero once arrived, until the robot has drifted off."""
        s = self._settings
        ahead = to_heading(self.episode.goal if percept.goal is None else percept.goal, state)
        distance = float(np.linalg.norm(ahead))
        self._stopped = distance <= (s.leave if self._stopped else s.arrive)
        velocity = np.zeros(3) if self._stopped else go_to_point(ahead, s.approach)
        text = None if self._stopped else s.text  # a robot that has arrived is told to stand
        return s.asked(Instruction(velocity=velocity, goal=ahead, text=text, stand=self._stopped))

    def done(self, state: State) -> bool:
        """Arrived, and standing for 1 s where that is asked."""
        standing = self._standing.update(state) or not self._settings.stand
        return standing and self._stopped


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

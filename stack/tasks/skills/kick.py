"""Kick a ball that lies at a foot."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Criterion, Episode, Trace
from servoid.hw.contracts.world import Percept, Scene, SceneObject
from servoid.hw.geometry import to_heading
from servoid.hw.robot.description import Robot, shipped_robot
from servoid.hw.setting import Setting
from servoid.stack.skills.skill import chosen, load_skills
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, Settings

LOOK_SECONDS = 0.5  # that the robot stands and looks before it kicks
AFTER_SECONDS = 2.0  # to come back to standing
SIDES = {"left": 1.0, "right": -1.0}


@dataclass(frozen=True)
class KickSettings(Settings):
    foot: Annotated[Literal["left", "right", "any"], Setting("that kicks; any: drawn")] = "any"
    ahead: Annotated[
        float, Setting("the ball's middle ahead of the base, where the foot reaches it", "m", least=0.09, most=0.17)
    ] = 0.13
    aside: Annotated[float, Setting("the ball's middle to the side of the foot", "m", least=0.02, most=0.08)] = 0.05
    jitter: Annotated[float, Setting("how far the ball lies from there at most, each way", "m", least=0)] = 0.01
    diameter: Annotated[float, Setting("diameter of the ball", "m", above=0)] = 0.07
    mass: Annotated[float, Setting("mass of the ball", "kg", above=0)] = 0.04
    least: Annotated[float, Setting("speed of the ball that a success takes", "m/s", least=0)] = 1.0
    angle: Annotated[float, Setting("how far from straight ahead it may roll then", "rad", above=0)] = 0.35


@dataclass(frozen=True, kw_only=True)
class BallAtFoot(Episode):
    foot: str


class Kick(BaseTask):
    name = "kick"
    description = "kick a ball that lies at a foot"
    settings_type = KickSettings
    performs = True
    guided_by_velocity_alone = True

    def __init__(self, settings: KickSettings, dt: float, robot: Robot | None = None) -> None:
        """Raises ConfigError for a robot that has no such skills."""
        super().__init__(settings, dt, robot)
        skills = load_skills(robot or shipped_robot())
        self._kicks = {foot: chosen(f"kick-{foot}", skills) for foot in SIDES}
        self.seconds = LOOK_SECONDS + max(kick.seconds for kick in self._kicks.values()) + AFTER_SECONDS

    def scenario(self, rng: np.random.Generator) -> BallAtFoot:
        """Draw the foot and where the ball lies."""
        s = self.settings
        drawn, off = str(rng.choice(sorted(SIDES))), rng.uniform(-s.jitter, s.jitter, 2)
        foot = drawn if s.foot == "any" else s.foot
        place = (s.ahead + float(off[0]), SIDES[foot] * s.aside + float(off[1]))
        ball = SceneObject("ball", place, (s.diameter,) * 3, s.mass)
        return BallAtFoot(Scene(np.zeros((0, 3)), np.zeros((0, 4)), objects=(ball,)), foot=foot)

    def behaviour(self, episode: BallAtFoot) -> BaseBehaviour:
        return _Kicks(episode, self.ticks(LOOK_SECONDS))

    def criteria(self, trace: Trace, episode: BallAtFoot) -> list[Criterion]:
        """Never fallen, and the ball rolled ahead, fast enough."""
        speed, angle = self._shot(trace)
        return [
            Criterion.never("fell", trace.fallen),
            Criterion.never("ended before it was done", len(trace.yaw) < self.ticks(self.seconds)),
            Criterion("speed of the ball", speed, "m/s", least=self.settings.least),
            Criterion("angle of the ball's way from straight ahead", abs(angle), "rad", most=self.settings.angle),
        ]

    def metrics(self, trace: Trace, episode: BallAtFoot) -> dict[str, float]:
        speed, angle = self._shot(trace)
        return {"ball_speed_mps": speed, "ball_angle_rad": angle, "ball_distance_m": self._rolled(trace)}

    def _shot(self, trace: Trace) -> tuple[float, float]:
        """Highest speed of the ball [m/s], a mean over a tick, and the angle of its way then from the robot's heading
        as the kick began [rad]."""
        places, begins = self._ball(trace), self.ticks(LOOK_SECONDS)
        if len(places) < begins + 2:
            return math.nan, math.nan
        velocity = np.diff(places[begins:], axis=0) / trace.dt
        speeds = np.linalg.norm(velocity, axis=1)
        fastest = velocity[int(speeds.argmax())]
        turn = math.atan2(fastest[1], fastest[0]) - float(trace.yaw[begins])
        return float(speeds.max()), (turn + math.pi) % (2 * math.pi) - math.pi

    def _rolled(self, trace: Trace) -> float:
        places = self._ball(trace)
        return float(np.linalg.norm(places[-1] - places[0])) if len(places) else math.nan

    def _ball(self, trace: Trace) -> Array:
        """Where the ball was seen `(ticks, 2)` m."""
        return np.zeros((0, 2)) if trace.objects is None else trace.objects[:, 0, :2]


class _Kicks(BaseBehaviour):
    def __init__(self, episode: BallAtFoot, begins: int) -> None:
        super().__init__(episode)
        self._begins, self._kicks = begins, False

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        """Look, then kick. Raises ConfigError where no ball is seen, or none that the foot reaches."""
        if percept.objects is None or not len(percept.objects):
            raise ConfigError("there is no ball to kick")
        if tick == self._begins:
            self._kicks = True
            x, y = to_heading(percept.objects[:1], state)[0, :2]
            if not (0.0 < x < 0.25 and 0.0 < SIDES[self.episode.foot] * y < 0.15):
                raise ConfigError(f"the ball is {x:.2f} m ahead and {y:.2f} m to the left: the foot does not reach it")
        return Instruction(velocity=np.zeros(3), skill=f"kick-{self.episode.foot}" if self._kicks else None)

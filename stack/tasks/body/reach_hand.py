"""Walk to a ball that hangs in the air and touch it with a hand."""

from __future__ import annotations

import math
from dataclasses import dataclass, field
from typing import Annotated, Literal

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Criterion, Episode, Trace
from servoid.hw.contracts.world import Percept, Scene, SceneObject
from servoid.hw.geometry import to_heading, up_vector
from servoid.hw.robot.description import Robot, shipped_robot
from servoid.hw.setting import Range, Setting
from servoid.stack.navigation.go_to_point import SpeedProfile, go_to_point
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, FreeSettings
from servoid.stack.tasks.body import build_of, reachable_heights
from servoid.stack.tasks.terms.body import Build, limb_ends

_SPARE = 0.01  # m nearer than need be that the robot must believe to be, before it is done


@dataclass(frozen=True)
class ReachHandSettings(FreeSettings):
    seconds: Annotated[float, Setting("length of an episode", "s", above=0)] = 40.0
    hand: Annotated[Literal["left", "right"], Setting("that touches")] = "right"
    distance: Annotated[
        Range, Setting("distance of the ball's middle from the start, over the ground", "m", above=0, of="height")
    ] = (0.35, 0.7)
    bearing: Annotated[Range, Setting("bearing of the ball at the start, to the left", "rad")] = (-1.0, 1.0)
    height: Annotated[Range, Setting("height of the ball's middle above the ground", "m", above=0, of="height")] = (
        0.17,
        0.21,
    )
    diameter: Annotated[float, Setting("diameter of the ball", "m", above=0, of="height")] = 0.07
    approach: SpeedProfile = field(default_factory=lambda: SpeedProfile(near=0.2))


class ReachHand(BaseTask):
    """The ball is seen, and nothing bumps into it: touched is when the middle of the hand is inside."""

    name = "reach-hand"
    description = "touch a ball in the air with a hand"
    settings_type = ReachHandSettings

    def __init__(self, settings: ReachHandSettings, dt: float, robot: Robot | None = None) -> None:
        """Raises ConfigError for a robot without such a hand, and for a ball where no hand comes to."""
        super().__init__(settings, dt, robot)
        who = robot or shipped_robot()
        self._part = f"{settings.hand} hand"
        self._build = build_of(who)
        if self._part not in self._build.limbs:
            raise ConfigError(f"reach-hand: {who.name} has no {self._part}: no limb of its MJCF ends at that side")
        low, high = reachable_heights(who, self._build.limbs[self._part])
        reach = settings.diameter / 2
        for height in settings.height:
            if not low - reach <= height <= high + reach:
                raise ConfigError(
                    f"reach-hand: height={height:g}: the {self._part} of {who.name} comes to between {low:.2f} m and"
                    f" {high:.2f} m above the ground, standing: the ball is out of its reach"
                )

    @property
    def build(self) -> Build:
        return self._build

    def scenario(self, rng: np.random.Generator) -> Episode:
        """Draw where the ball hangs."""
        s = self.settings
        distance, bearing, height = (rng.uniform(*span) for span in (s.distance, s.bearing, s.height))
        place = (distance * math.cos(bearing), distance * math.sin(bearing))
        ball = SceneObject("target", place, (s.diameter,) * 3, lift=height - s.diameter / 2)
        return Episode(Scene(np.zeros((0, 3)), np.zeros((0, 4)), objects=(ball,)))

    def behaviour(self, episode: Episode) -> BaseBehaviour:
        home = (self.robot or shipped_robot()).home
        return _Touch(episode, self.settings, self._build, self._part, home)

    def criteria(self, trace: Trace, episode: Episode) -> list[Criterion]:
        """Never fallen, and the hand was in the ball."""
        return [
            Criterion.never("fell", trace.fallen),
            Criterion("nearest the hand came", self._nearest(trace), "m", most=self.settings.diameter / 2),
        ]

    def metrics(self, trace: Trace, episode: Episode) -> dict[str, float]:
        apart = self._apart(trace)
        touched = np.flatnonzero(apart <= self.settings.diameter / 2)
        return {
            "nearest_m": self._nearest(trace),
            "touched": float(len(touched) > 0),
            "seconds_to_touch": float(touched[0] * trace.dt) if len(touched) else math.nan,
        }

    def _nearest(self, trace: Trace) -> float:
        return float(self._apart(trace).min(initial=math.inf))

    def _apart(self, trace: Trace) -> Array:
        """Distance of the hand from the ball's middle at each tick [m]; none for a run that never began."""
        if trace.objects is None or trace.joints is None or trace.orientation is None or not len(trace.objects):
            return np.zeros(0)
        limb = self._build.limbs[self._part]
        gravity = -up_vector(trace.orientation)
        hand = limb_ends(limb, trace.displacement, trace.yaw, gravity, trace.joints)
        apart: Array = np.linalg.norm(hand - trace.objects[:, 0, :3], axis=1)
        return apart


class _Touch(BaseBehaviour):
    def __init__(self, episode: Episode, settings: ReachHandSettings, build: Build, part: str, home: Array) -> None:
        super().__init__(episode)
        self._settings, self._part, self._limb = settings, part, build.limbs[part]
        self._hand = self._limb.end(home)[0]  # m, base frame, where it is while the robot walks
        self._ball = self._at_start()
        self._apart = math.inf

    def _at_start(self) -> Array:
        (ball,) = self.episode.scene.objects
        return np.array([*ball.place, ball.height])

    def percept(self, state: State) -> Percept:
        """Where the ball was put: nobody sees it."""
        return Percept(source="task", age=0.0, objects=np.array([[*self._at_start(), 1.0, 0.0, 0.0, 0.0]]))

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        """The ball as the hand's target, and a velocity that takes the hand there as it hangs while walking."""
        if percept.objects is not None and len(percept.objects):
            self._ball = percept.objects[0, :3]
        hand = limb_ends(self._limb, state.displacement, state.yaw, state.gravity, state.position)
        self._apart = float(np.linalg.norm(hand - self._ball))
        ball = to_heading(self._ball, state)
        s = self._settings
        # The script's goal is where the base would be with the hand on the ball, facing as it faces now.
        velocity = go_to_point(ball[:2] - self._hand[:2], s.approach)
        return s.asked(Instruction(velocity=velocity, targets={self._part: ball}))

    def done(self, state: State) -> bool:
        """Touched, as the robot believes, with something to spare."""
        return self._apart <= self._settings.diameter / 2 - _SPARE

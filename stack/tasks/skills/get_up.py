"""Get up from lying: on the front, on the back, anyhow, or while rolling."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Criterion, Episode, Trace
from servoid.hw.contracts.world import Percept, Start
from servoid.hw.geometry import multiply
from servoid.hw.robot.description import shipped_robot
from servoid.hw.setting import Setting
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, Settings

STANDS = 0.8  # of the standing height: it is up from there
DROPPED = 0.05  # m that one which rolls is dropped by
ROLLS = 4.0  # rad/s about its length, at most


@dataclass(frozen=True)
class GetUpSettings(Settings):
    seconds: Annotated[float, Setting("length of an episode", "s", above=0)] = 12.0
    lying: Annotated[
        Literal["front", "back", "anyhow", "rolling"],
        Setting("front or back, anyhow (any side, joints drawn too), or rolling (the same, dropped and turning)"),
    ] = "anyhow"
    bend: Annotated[float, Setting("how far a joint may be from home, where joints are drawn", "rad", least=0)] = 0.5


class LieAndStand(BaseTask):
    name = "get-up"
    description = "get up from lying and stand; give --recover"
    settings_type = GetUpSettings

    def scenario(self, rng: np.random.Generator) -> Episode:
        """Draw how the robot lies."""
        s, robot = self.settings, self.robot or shipped_robot()
        drawn = s.lying in ("anyhow", "rolling")
        roll, noise = rng.uniform(-math.pi, math.pi), rng.uniform(-1.0, 1.0, 3)
        side = {"front": 0.0, "back": math.pi}.get(s.lying, roll)
        # Pitched forward by a right angle it lies on its front; then turned about its length, which is level.
        length = _turn(np.array([0.0, 0.0, 1.0]), side + (0.0 if drawn else 0.2 * noise[0]))
        orientation = multiply(_turn(np.array([0.0, 1.0, 0.0]), math.pi / 2 + 0.1 * noise[1]), length)
        bent = robot.home + s.bend * rng.uniform(-1.0, 1.0, len(robot.joints))
        position = spin = None
        if s.lying == "rolling":
            position = np.array([[0.0, 0.0, 0.15 + DROPPED]])
            spin = np.array([[0.0, 0.0, ROLLS * noise[2]]])
        start = Start(
            joints=np.clip(bent, robot.lower, robot.upper)[None] if drawn else None,
            position=position,
            orientation=orientation[None],
            angular_velocity=spin,
        )
        return Episode(start=start)

    def behaviour(self, episode: Episode) -> BaseBehaviour:
        return _Stand(episode)

    def criteria(self, trace: Trace, episode: Episode) -> list[Criterion]:
        """It stands at the end."""
        return [
            Criterion.never("ended lying", trace.fallen),
            Criterion.never("ended before it began", len(trace.displacement) == 0),
            Criterion("height at the end, of the standing height", self._height(trace), least=STANDS),
        ]

    def metrics(self, trace: Trace, episode: Episode) -> dict[str, float]:
        return {"seconds_until_up": self._up(trace)}

    def _height(self, trace: Trace) -> float:
        robot = self.robot or shipped_robot()
        return float(trace.displacement[-1, 2]) / robot.standing_height if len(trace.displacement) else math.nan

    def _up(self, trace: Trace) -> float:
        """From the start of the task until the base was up and stayed so [s]; NaN where it is not up at the end."""
        robot = self.robot or shipped_robot()
        low = np.flatnonzero(trace.displacement[:, 2] < STANDS * robot.standing_height)
        if trace.fallen or not len(trace.displacement) or (len(low) and low[-1] == len(trace.displacement) - 1):
            return math.nan
        return float(low[-1] + 1) * trace.dt if len(low) else 0.0


class _Stand(BaseBehaviour):
    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        return Instruction(velocity=np.zeros(3))


def _turn(axis: Array, angle: float) -> Array:
    return np.concatenate([[math.cos(angle / 2)], math.sin(angle / 2) * axis])

"""The tasks that policies learn, as tasks that are run: what is asked changes in steps, and the return judges.

The return is the mean of the task's own reward, 0 to 1, over the whole episode; what a fall or a hit left undone earns
nothing.
"""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated, ClassVar

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Criterion, Episode, Trace
from servoid.hw.contracts.world import Percept
from servoid.hw.robot.description import Robot, shipped_robot
from servoid.hw.setting import Setting
from servoid.stack.navigation.go_to_point import SpeedProfile, go_to_point
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, Settings
from servoid.stack.tasks.learned.base import LearnedTask, TaskState
from servoid.stack.tasks.learned.dodgeball import Dodgeball
from servoid.stack.tasks.learned.location import TargetLocation
from servoid.stack.tasks.learned.speed import TargetSpeed
from servoid.stack.tasks.learned.steering import TargetSteering
from servoid.stack.tasks.terms import metrics as measures


@dataclass(frozen=True)
class LearnedSettings(Settings):
    least: Annotated[float, Setting("least return of a success", least=0)] = 0.5


@dataclass(frozen=True)
class SpeedSettings(LearnedSettings):
    steady: Annotated[float, Setting("one speed all the time, instead of those drawn; 0: drawn", "m/s", least=0)] = 0.0


@dataclass(frozen=True, kw_only=True)
class Draws(Episode):
    seeds: Array  # (draws,) of what is asked: some of it lies around where the robot then is
    ticks: Array  # (draws,) at which it is asked, the first 0

    def number(self, tick: int) -> int:
        """Which draw is asked at a tick."""
        return int(np.searchsorted(self.ticks, tick, side="right")) - 1


class LearnedRun(BaseTask):
    """Runs `learned`; the draws of an episode are the same for every policy, around where each of them is."""

    learned: ClassVar[type[LearnedTask]]
    settings_type = LearnedSettings
    counts_undone = ("return",)

    def __init__(self, settings: LearnedSettings, dt: float, robot: Robot | None = None) -> None:
        super().__init__(settings, dt, robot)
        self.asks = self.learned(robot or shipped_robot())

    def scenario(self, rng: np.random.Generator) -> Draws:
        times, end = [0.0], self.seconds
        while times[-1] < end:
            times.append(times[-1] + rng.uniform(*self.asks.every))
        ticks = np.round(np.array(times[:-1]) / self.dt).astype(int)
        return Draws(seeds=rng.integers(2**31, size=len(ticks)), ticks=ticks)

    def drawn(self, episode: Draws, number: int, position: Array) -> Array:
        """What is asked at a draw of the robot, whose base is at `position` `(2,)` m: `(size,)`."""
        return self.asks.draw(np.random.default_rng(episode.seeds[number]), position)

    def told(self, asked: Array, state: State) -> Instruction:
        """What the robot is told of `asked` `(size,)`."""
        return self.asks.instruct(asked, state)

    def behaviour(self, episode: Draws) -> BaseBehaviour:
        return _AskAnew(episode, self)

    def criteria(self, trace: Trace, episode: Draws) -> list[Criterion]:
        earned = self.metrics(trace, episode)["return"]
        return [Criterion.never("fell", trace.fallen), Criterion("return", earned, least=self.settings.least)]

    def metrics(self, trace: Trace, episode: Draws) -> dict[str, float]:
        rewards = self.rewards(trace, episode)
        whole = max(round(self.seconds / self.dt), len(rewards), 1)
        return {"return": float(rewards.sum() / whole), "distance_m": measures.path_length(trace, self.cycle)}

    def rewards(self, trace: Trace, episode: Draws) -> Array:
        """The task's reward at each tick `(ticks,)`: zero from where the task is over."""
        known, n = _states(trace, self.ticks(self.cycle)), len(trace.yaw)
        found, before = np.zeros(n), -1
        for tick in range(n):
            at = known.only(slice(tick, tick + 1))
            if (number := episode.number(tick)) != before:
                asked, before = self.drawn(episode, number, at.position[0])[None], number
            if self.asks.ended(asked, at)[0]:
                break
            found[tick] = self.asks.reward(asked, at)[0]
            asked = self.asks.advance(asked, self.dt)
        return found


class _AskAnew(BaseBehaviour):
    def __init__(self, episode: Draws, task: LearnedRun) -> None:
        super().__init__(episode)
        self._task, self._number, self._tick = task, -1, 0
        self._asked = np.zeros(0)

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        task = self._task
        number = self.episode.number(tick)
        if number != self._number:
            self._asked = task.drawn(self.episode, number, state.displacement[:2])
        else:
            self._asked = task.asks.advance(self._asked[None], (tick - self._tick) * task.dt)[0]
        self._number, self._tick = number, tick
        return task.told(self._asked, state)


def _states(trace: Trace, cycle: int) -> TaskState:
    """Over a trace, a row for each tick, NaN where it does not tell; velocity is averaged over the
    last `cycle` ticks, before the first of which the robot stood where it began."""
    place, n = trace.displacement[:, :2], len(trace.yaw)
    before = np.concatenate([np.tile(place[:1], (cycle, 1)), place])[:n]
    unknown = np.full((n, 3), math.nan)
    velocity, height = (place - before) / (cycle * trace.dt), trace.displacement[:, 2]
    joints = unknown if trace.joints is None else trace.joints
    rates = np.full_like(joints, math.nan)
    return TaskState(place, trace.yaw, velocity, height, unknown, unknown, joints, rates, trace.objects)


class RunSpeed(LearnedRun):
    name = "speed"
    description = "walk straight on at a speed that changes in steps"
    learned, settings_type = TargetSpeed, SpeedSettings

    def drawn(self, episode: Draws, number: int, position: Array) -> Array:
        steady: float = self.settings.steady
        return np.array([steady]) if steady else super().drawn(episode, number, position)


class RunSteering(LearnedRun):
    name = "steering"
    description = "move one way over the ground, and face another"
    learned = TargetSteering


class RunLocation(LearnedRun):
    name = "location"
    description = "go to a place, and to another every few seconds"
    learned = TargetLocation

    def told(self, asked: Array, state: State) -> Instruction:
        """The place, and for policies that know no places the velocity that leads there, by a script."""
        told = super().told(asked, state)
        velocity = told.velocity if told.goal is None else go_to_point(told.goal, SpeedProfile())
        return replace(told, velocity=velocity)


class RunDodgeball(LearnedRun):
    name = "dodgeball"
    description = "get out of the way of balls, which are not there in physics"
    learned = Dodgeball

    def criteria(self, trace: Trace, episode: Draws) -> list[Criterion]:
        return [Criterion.never("fell", trace.fallen), Criterion.never("was hit", self._hit(trace, episode))]

    def metrics(self, trace: Trace, episode: Draws) -> dict[str, float]:
        return {**super().metrics(trace, episode), "hit": float(self._hit(trace, episode))}

    def _hit(self, trace: Trace, episode: Draws) -> bool:
        """Whether a ball hit: from there on nothing is earned, and until then something is."""
        return not self.rewards(trace, episode)[-1:].all()

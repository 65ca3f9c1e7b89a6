"""Walk with a velocity that is given over the ground and changes in steps; turn to face where it points."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Criterion, Episode, Trace
from servoid.hw.contracts.world import Percept
from servoid.hw.geometry import turned
from servoid.hw.setting import Range, Setting
from servoid.policy.references.gait import load_gait
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, FreeSettings
from servoid.stack.tasks.terms import metrics as measures


@dataclass(frozen=True)
class VelocitySettings(FreeSettings):
    seconds: Annotated[float, Setting("length of an episode", "s", above=0)] = 183.0
    speed: Annotated[Range, Setting("speed over the ground", "m/s", least=0, asks="forward")] = (0.0, 0.44)
    turn: Annotated[Range, Setting("how far the direction changes each time", "rad")] = (-1.0, 1.0)
    every: Annotated[float, Setting("time between changes", "s", above=0)] = 8.7
    settle: Annotated[float, Setting("time after each change that does not count", "s", least=0)] = 2.1
    cycle: Annotated[
        float, Setting("length of a gait cycle: velocity is averaged over it", "s", above=0, of="cycle")
    ] = field(default_factory=lambda: load_gait().cycle)
    tolerance: Annotated[float, Setting("largest mean velocity error of a success", "m/s", above=0)] = 0.04
    turn_gain: Annotated[float, Setting("turning rate for each rad of wrong heading", "1/s", above=0)] = 1.5
    yaw_rate: Annotated[float, Setting("fastest turn", "rad/s", above=0, asks="turning")] = 0.8

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.settle + self.cycle > self.every:
            raise ValueError(f"settle: {self.settle:g} s leaves no cycle of {self.cycle:g} s of every {self.every:g} s")


@dataclass(frozen=True, kw_only=True)
class Velocities(Episode):
    direction: Array  # (changes,) rad over the ground
    velocity: Array  # (changes, 2) m/s over the ground


class Velocity(BaseTask):
    name = "velocity"
    description = "follow a velocity over the ground that changes in steps"
    settings_type = VelocitySettings
    counts_undone = ("velocity_error_mps",)

    def scenario(self, rng: np.random.Generator) -> Velocities:
        """Draw all velocities of the episode; the first points ahead."""
        s = self.settings
        changes = math.ceil(self.seconds / s.every)
        speed = rng.uniform(s.speed[0], s.speed[1], changes)
        turn = rng.uniform(s.turn[0], s.turn[1], changes)
        turn[0] = 0.0
        direction = np.cumsum(turn)
        velocity = speed[:, None] * np.stack([np.cos(direction), np.sin(direction)], axis=-1)
        return Velocities(direction=direction, velocity=velocity)

    def behaviour(self, episode: Velocities) -> BaseBehaviour:
        return _FaceAndWalk(episode, self.settings, self.ticks(self.settings.every))

    def criteria(self, trace: Trace, episode: Velocities) -> list[Criterion]:
        error = self._error(trace, episode)
        return [
            Criterion.never("fell", trace.fallen),
            Criterion("mean velocity error", error, "m/s", most=self.settings.tolerance),
        ]

    def metrics(self, trace: Trace, episode: Velocities) -> dict[str, float]:
        return {
            "velocity_error_mps": self._error(trace, episode),
            "top_speed_mps": measures.top_speed(trace),
            "distance_m": measures.path_length(trace, self.settings.cycle),
        }

    def _error(self, trace: Trace, episode: Velocities) -> float:
        """Mean |measured - asked| planar velocity over the ground [m/s], over whole gait cycles of what counts.

        Cycles that the run did not come to count as if the robot had stood: else the sooner it falls, the better.
        """
        every, cycle = self.ticks(self.settings.every), self.ticks(self.settings.cycle)
        ticks = round(self.seconds / self.dt)
        errors = []
        for start, end in itertools.pairwise([*range(0, ticks, every), ticks]):
            asked = episode.velocity[min(start // every, len(episode.velocity) - 1)]
            for first in range(start + round(self.settings.settle / self.dt), end - cycle + 1, cycle):
                if first + cycle > len(trace.yaw):
                    errors.append(np.linalg.norm(asked))
                    continue
                rows = slice(first, first + cycle)
                ground = turned(trace.velocity[rows, :2], trace.yaw[rows]).mean(0)
                errors.append(np.linalg.norm(ground - asked))
        return float(np.mean(errors)) if errors else float("nan")


class _FaceAndWalk(BaseBehaviour):
    """Until it faces the way, the robot walks by the part of the velocity that lies ahead: it can hardly sidestep."""

    def __init__(self, episode: Velocities, settings: VelocitySettings, ticks: int) -> None:
        super().__init__(episode)
        self._settings, self._ticks = settings, ticks

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        s, number = self._settings, min(tick // self._ticks, len(self.episode.velocity) - 1)
        velocity = self.episode.velocity[number]
        ahead = turned(velocity, -state.yaw)
        off = (self.episode.direction[number] - float(state.yaw) + math.pi) % (2.0 * math.pi) - math.pi
        turn = min(max(s.turn_gain * off, -s.yaw_rate), s.yaw_rate)
        if not velocity.any() and abs(off) < 0.05:
            turn = 0.0  # asked to stand, and facing the right way: no stepping on the spot
        return s.asked(Instruction(velocity=np.array([max(float(ahead[0]), 0.0), 0.0, turn]), ground=ahead))

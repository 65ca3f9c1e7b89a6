"""Walk with a velocity that is given over the ground and changes in steps; turn to face where it points."""

from __future__ import annotations

import itertools
import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Trace
from servoid.hw.contracts.world import Percept
from servoid.hw.geometry import turned
from servoid.stack.tasks import metrics as measures
from servoid.stack.tasks.base import BaseTask, Range, Settings, require_positive, require_ranges


@dataclass(frozen=True)
class VelocitySettings(Settings):
    seconds: Annotated[float, "s, length of the episode"] = 183.0
    speed: Annotated[Range, "m/s, one value or low:high"] = (0.0, 0.44)
    turn: Annotated[Range, "rad by which the direction changes each time, one value or low:high"] = (-1.0, 1.0)
    every: Annotated[float, "s between changes"] = 8.7
    settle: Annotated[float, "s after each change that do not count"] = 2.1
    cycle: Annotated[float, "s, length of a gait cycle, over which the measured velocity is averaged"] = 0.48
    tolerance: Annotated[float, "m/s of mean error that count as followed"] = 0.04
    turn_gain: Annotated[float, "rad/s per rad of wrong heading"] = 1.5
    yaw_rate: Annotated[float, "rad/s at most"] = 0.8

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "every", "cycle", "tolerance", "turn_gain", "yaw_rate")
        require_ranges(self, "speed", "turn")
        if self.speed[0] < 0.0:
            raise ValueError("speed: must not be negative; its direction is drawn")
        if self.settle < 0.0 or self.settle + self.cycle > self.every:
            raise ValueError(f"settle: {self.settle:g} s leaves no cycle of {self.cycle:g} s of every {self.every:g} s")


class Velocity(BaseTask):
    name = "velocity"
    description = "walk with a velocity over the ground that changes in steps"
    settings_type = VelocitySettings
    counts_undone = ("velocity_error_mps",)

    def reset(self, rng: np.random.Generator) -> None:
        """Draw all velocities of the episode; the first points ahead."""
        changes = math.ceil(self.seconds / self.settings.every)
        speed = rng.uniform(self.settings.speed[0], self.settings.speed[1], changes)
        turn = rng.uniform(self.settings.turn[0], self.settings.turn[1], changes)
        turn[0] = 0.0
        self._direction: Array = np.cumsum(turn)
        self._velocity: Array = speed[:, None] * np.stack([np.cos(self._direction), np.sin(self._direction)], axis=-1)

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        number = self._segment(tick)
        ahead = turned(self._velocity[number], -state.yaw)
        off = (self._direction[number] - float(state.yaw) + math.pi) % (2.0 * math.pi) - math.pi
        turn = min(max(self.settings.turn_gain * off, -self.settings.yaw_rate), self.settings.yaw_rate)
        if not self._velocity[number].any() and abs(off) < 0.05:
            turn = 0.0  # asked to stand, and facing the right way: no stepping on the spot
        # Until it faces the way, it walks by the part of the velocity that lies ahead: sideways it can hardly go.
        return Instruction(velocity=np.array([max(float(ahead[0]), 0.0), 0.0, turn]), ground=ahead)

    def success(self, trace: Trace) -> bool:
        return not trace.fallen and self._error(trace) <= self.settings.tolerance

    def metrics(self, trace: Trace) -> dict[str, float]:
        return {
            "velocity_error_mps": self._error(trace),
            "top_speed_mps": measures.top_speed(trace),
            "distance_m": measures.path_length(trace, self.settings.cycle),
        }

    def _segment(self, tick: int) -> int:
        return min(tick // max(round(self.settings.every / self.dt), 1), len(self._velocity) - 1)

    def _error(self, trace: Trace) -> float:
        """Mean |measured - asked| planar velocity over the ground [m/s], over whole gait cycles of what counts.

        Cycles that the run did not come to count as if the robot had stood: else the sooner it falls, the better.
        """
        every, cycle = max(round(self.settings.every / self.dt), 1), max(round(self.settings.cycle / self.dt), 1)
        ticks = round(self.seconds / self.dt)
        errors = []
        for start, end in itertools.pairwise([*range(0, ticks, every), ticks]):
            for first in range(start + round(self.settings.settle / self.dt), end - cycle + 1, cycle):
                if first + cycle > len(trace.yaw):
                    errors.append(np.linalg.norm(self._velocity[self._segment(start)]))
                    continue
                rows = slice(first, first + cycle)
                ground = turned(trace.velocity[rows, :2], trace.yaw[rows]).mean(0)
                errors.append(np.linalg.norm(ground - self._velocity[self._segment(start)]))
        return float(np.mean(errors)) if errors else float("nan")

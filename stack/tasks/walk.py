"""Walk with a commanded velocity that changes in steps, with or without pushes."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Trace
from servoid.hw.contracts.world import Percept
from servoid.stack.tasks import metrics as measures
from servoid.stack.tasks.base import BaseTask, Range, Settings, require_positive, require_ranges

_COMPONENTS = ("vx", "vy", "yaw_rate")


@dataclass(frozen=True)
class WalkSettings(Settings):
    vx: Annotated[Range, "m/s forward, one value or low:high; fixing one component sets the others to 0"] = (-0.1, 0.3)
    vy: Annotated[Range, "m/s to the left, one value or low:high"] = (-0.1, 0.1)
    yaw_rate: Annotated[Range, "rad/s to the left, one value or low:high"] = (-0.8, 0.8)
    every: Annotated[float, "s between changes of the command"] = 5.0
    push: Annotated[Range, "m/s of velocity change of each push, one value or low:high"] = (0.0, 0.0)
    push_every: Annotated[float, "s between pushes"] = 1.0
    cycle: Annotated[float, "s, length of a gait cycle, over which the measured velocity is averaged"] = 0.48
    tolerance: Annotated[float | None, "m/s of mean error that count as followed; none: not falling is enough"] = 0.1

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "every", "push_every", "cycle")
        if self.tolerance is not None:
            require_positive(self, "tolerance")
        require_ranges(self, *_COMPONENTS, "push")
        if self.push[0] < 0.0:
            raise ValueError("push: must not be negative; its direction is random")


class Walk(BaseTask):
    name = "walk"
    description = "walk with a commanded velocity, drawn anew every few seconds"
    settings_type = WalkSettings

    @staticmethod
    def complete(settings: dict[str, str]) -> dict[str, str]:
        """With some components given, the others are zero: `vx=0.6` walks straight ahead."""
        if any(name in settings for name in _COMPONENTS):
            return {**dict.fromkeys(_COMPONENTS, "0"), **settings}
        return settings

    def reset(self, rng: np.random.Generator) -> None:
        """Draw all commands and pushes of the episode."""
        ranges = np.array([getattr(self.settings, name) for name in _COMPONENTS])
        segments = math.ceil(self.seconds / self.settings.every)
        self._commands: Array = rng.uniform(ranges[:, 0], ranges[:, 1], size=(segments, 3))
        pushes = math.ceil(self.seconds / self.settings.push_every)
        size = rng.uniform(self.settings.push[0], self.settings.push[1], size=pushes)
        bearing = rng.uniform(-math.pi, math.pi, size=pushes)
        self._pushes: Array = size[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], axis=-1)

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        segment = tick // max(round(self.settings.every / self.dt), 1)
        return Instruction(velocity=self._commands[min(segment, len(self._commands) - 1)].copy())

    @property
    def pushes(self) -> bool:
        return self.settings.push[1] > 0.0

    def disturbance(self, tick: int) -> Array | None:
        """A push at each whole interval, the first one interval after the start."""
        number, rest = divmod(tick, max(round(self.settings.push_every / self.dt), 1))
        if rest or not 1 <= number <= len(self._pushes) or self.settings.push[1] == 0.0:
            return None
        return self._pushes[number - 1].copy()

    def success(self, trace: Trace) -> bool:
        """Never fallen, and the velocity followed, as far as the run was long enough for a gait cycle that counts."""
        error, tolerance = measures.velocity_error(trace, self.settings.cycle), self.settings.tolerance
        followed = tolerance is None or not error > tolerance
        return followed and not trace.fallen and len(trace.displacement) > 0

    def metrics(self, trace: Trace) -> dict[str, float]:
        return {
            "velocity_error_mps": measures.velocity_error(trace, self.settings.cycle),
            "top_speed_mps": measures.top_speed(trace),
            "distance_m": measures.path_length(trace, self.settings.cycle),
        }

"""Walk as a person steers, with a gamepad or by keys."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Any, Literal

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Trace
from servoid.hw.contracts.world import Percept
from servoid.stack.control.operator import Recorded, Steering, Wish, open_steering
from servoid.stack.tasks import metrics as measures
from servoid.stack.tasks.base import BaseTask, Settings, require_positive


@dataclass(frozen=True)
class SteerSettings(Settings):
    device: Annotated[Literal["auto", "gamepad", "keyboard"], "auto, gamepad or keyboard (of the terminal)"] = "auto"
    forward: Annotated[float, "m/s at the end of the stick's way"] = 0.25
    backward: Annotated[float, "m/s"] = 0.1
    sideways: Annotated[float, "m/s"] = 0.1
    turning: Annotated[float, "rad/s"] = 0.8

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "forward", "backward", "sideways", "turning")


class Steer(BaseTask):
    """Velocities are rounded to float32, as the flight log holds them: a replay steers by the log."""

    name = "steer"
    description = "walk as a person steers, with a gamepad or by keys"
    settings_type = SteerSettings
    steered = True

    def __init__(self, settings: SteerSettings, dt: float) -> None:
        super().__init__(settings, dt)
        self._device: Steering | None = None
        self._recorded: Recorded | None = None
        self._wish = Wish(np.zeros(3))

    def __getstate__(self) -> dict[str, Any]:
        """Without the device: a planner's process needs the cost alone."""
        return {**self.__dict__, "_device": None}

    def steer_by(self, velocities: Array, ended: bool) -> None:
        """Follow a recorded run's velocities `(ticks, 3)`; `ended`: whether with the last one the person ended it."""
        self._recorded = Recorded(velocities, ended)

    def reset(self, rng: np.random.Generator) -> None:
        """Find the device. Raises ConfigError where there is none."""
        if self._device is None:
            self._device = self._recorded or open_steering(self.settings.device)

    def close(self) -> None:
        """Let go of the device."""
        if self._device is not None:
            self._device.close()
            self._device = None

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        if self._device is not None:
            self._wish = self._device.read()
        if self._recorded is not None:
            return Instruction(velocity=self._wish.way.astype(float))
        s, (forward, left, turn) = self.settings, self._wish.way
        velocity = [forward * (s.forward if forward > 0.0 else s.backward), left * s.sideways, turn * s.turning]
        return Instruction(velocity=np.array(velocity, dtype=np.float32).astype(float))

    def done(self, state: State) -> bool:
        """The person has had enough."""
        return self._wish.ends

    def success(self, trace: Trace) -> bool:
        return not trace.fallen and len(trace.displacement) > 0

    def metrics(self, trace: Trace) -> dict[str, float]:
        return {
            "top_speed_mps": measures.top_speed(trace),
            "distance_m": measures.path_length(trace, step=0.48),
        }

"""Walk as a person steers, with a gamepad or by keys."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Criterion, Episode, Trace
from servoid.hw.contracts.world import Percept
from servoid.hw.setting import Setting
from servoid.stack.control.operator import Controls, Steering, open_steering
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, Settings
from servoid.stack.tasks.terms import metrics as measures

Stick = Literal["leftx", "lefty", "rightx", "righty"]


@dataclass(frozen=True)
class SteerSettings(Settings):
    device: Annotated[Literal["auto", "gamepad", "keyboard"], Setting("auto, gamepad or keyboard")] = "auto"
    forward: Annotated[float, Setting("forward, with the stick pushed all the way", "m/s", above=0, asks="forward")] = (
        0.25
    )
    backward: Annotated[float, Setting("backward, the same", "m/s", above=0, asks="backward")] = 0.1
    sideways: Annotated[float, Setting("to either side, the same", "m/s", above=0, asks="left")] = 0.1
    turning: Annotated[float, Setting("turning, the same", "rad/s", above=0, asks="turning")] = 0.8
    forward_stick: Annotated[Stick, Setting("part of the gamepad that walks forward and back")] = "lefty"
    sideways_stick: Annotated[Stick, Setting("part of it that walks sideways")] = "leftx"
    turning_stick: Annotated[Stick, Setting("part of it that turns")] = "rightx"
    end_button: Annotated[Literal["a", "b", "x", "y"], Setting("button of it that ends the run")] = "b"


class Steer(BaseTask):
    name = "steer"
    description = "walk as a person steers, with a gamepad or by keys"
    settings_type = SteerSettings
    steered = True

    def behaviour(self, episode: Episode) -> BaseBehaviour:
        """Find the device. Raises ConfigError where there is none."""
        s = self.settings
        controls = Controls(s.forward_stick, s.sideways_stick, s.turning_stick, s.end_button)
        return Steered(episode, open_steering(s.device, controls), s)

    def criteria(self, trace: Trace, episode: Episode) -> list[Criterion]:
        return [
            Criterion.never("fell", trace.fallen),
            Criterion.never("ended before it began", len(trace.displacement) == 0),
        ]

    def metrics(self, trace: Trace, episode: Episode) -> dict[str, float]:
        return {
            "top_speed_mps": measures.top_speed(trace),
            "distance_m": measures.path_length(trace, self.cycle),
        }


class Steered(BaseBehaviour):
    """Velocities are rounded to float32, as the flight log holds them: a replay steers by the log."""

    def __init__(self, episode: Episode, device: Steering, settings: SteerSettings) -> None:
        super().__init__(episode)
        self._device, self._settings, self._ends = device, settings, False

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        wish, s = self._device.read(), self._settings
        forward, left, turn = wish.way
        self._ends = wish.ends
        velocity = [forward * (s.forward if forward > 0.0 else s.backward), left * s.sideways, turn * s.turning]
        return Instruction(velocity=np.array(velocity, dtype=np.float32).astype(float))

    def done(self, state: State) -> bool:
        """The person has had enough."""
        return self._ends

    def close(self) -> None:
        self._device.close()


class SteeredAgain(BaseBehaviour):
    """Repeats the velocities `(ticks, 3)` of a recorded run. `ended`: whether with the last one the person ended it."""

    def __init__(self, velocities: Array, ended: bool) -> None:
        super().__init__(Episode())
        self._velocities, self._ended, self._tick = velocities, ended, 0

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        self._tick = tick
        over = tick >= len(self._velocities)
        return Instruction(velocity=np.zeros(3) if over else self._velocities[tick].astype(float))

    def done(self, state: State) -> bool:
        return self._ended and self._tick >= len(self._velocities) - 1

"""Carrying as a task that is run: the box stands somewhere ahead, and its place somewhere around it."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace
from typing import Annotated

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Criterion, Trace
from servoid.hw.contracts.world import Percept, Scene
from servoid.hw.setting import Setting
from servoid.stack.control.carrier import LIFTED
from servoid.stack.tasks.base import BaseBehaviour
from servoid.stack.tasks.learned.carry import Carry, seen_box
from servoid.stack.tasks.learned.run import Draws, LearnedRun, LearnedSettings


@dataclass(frozen=True)
class CarrySettings(LearnedSettings):
    seconds: Annotated[float, Setting("length of an episode", "s", above=0)] = 25.0
    within: Annotated[float, Setting("how near its place the box must be at the end, held", "m", above=0)] = 0.1


class RunCarry(LearnedRun):
    name = "carry"
    description = "pick up a box from the ground and bring it to a place"
    learned, settings_type = Carry, CarrySettings

    def scenario(self, rng: np.random.Generator) -> Draws:
        """Draw where the box stands and where it shall go."""
        asks = self.asks
        assert isinstance(asks, Carry)
        box = asks.place(rng)
        thing = replace(asks.scene.objects[0], place=(float(box[0, 0]), float(box[0, 1])), heading=_heading(box[0]))
        scene = Scene(np.zeros((0, 3)), np.zeros((0, 4)), objects=(thing,))
        return Draws(scene, low=True, seeds=rng.integers(2**31, size=1), ticks=np.zeros(1, int))

    def behaviour(self, episode: Draws) -> BaseBehaviour:
        return _Brings(episode, self)

    def criteria(self, trace: Trace, episode: Draws) -> list[Criterion]:
        """Never fallen, and at the end the box is held, at its place."""
        found = self.metrics(trace, episode)
        return [
            Criterion.never("fell", trace.fallen),
            Criterion.never("box not held at the end", found["held"] < 1.0),
            Criterion("box from its place at the end", found["box_from_place_m"], "m", most=self.settings.within),
        ]

    def metrics(self, trace: Trace, episode: Draws) -> dict[str, float]:
        found = super().metrics(trace, episode)
        boxes = np.zeros((0, 7)) if trace.objects is None else trace.objects[:, 0]
        if not len(boxes):
            return {**found, "lifted": 0.0, "held": 0.0, "box_from_place_m": math.nan}
        place = self.drawn(episode, 0, trace.displacement[0, :2])
        return {
            **found,
            "lifted": float((boxes[:, 2] > LIFTED).any()),
            "held": float(boxes[-1, 2] > LIFTED),
            "box_from_place_m": float(np.linalg.norm(boxes[-1, :2] - place)),
        }


class _Brings(BaseBehaviour):
    def __init__(self, episode: Draws, task: RunCarry) -> None:
        super().__init__(episode)
        self._task, self._place = task, np.zeros(0)

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        """Raises ConfigError where no box is seen."""
        if percept.objects is None or not len(percept.objects):
            raise ConfigError("there is no box to carry")
        if not len(self._place):
            self._place = self._task.drawn(self.episode, 0, state.displacement[:2])
        return replace(self._task.told(self._place, state), box=seen_box(percept.objects[0], state))


def _heading(pose: Array) -> float:
    """Of an upright box [rad]."""
    return 2.0 * math.atan2(float(pose[6]), float(pose[3]))

"""Stand still."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Criterion, Episode, Trace
from servoid.hw.contracts.world import Percept
from servoid.hw.setting import Setting
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, Settings


@dataclass(frozen=True)
class StandSettings(Settings):
    radius: Annotated[float, Setting("how far the base may wander", "m", above=0)] = 0.1


class Stand(BaseTask):
    name = "stand"
    description = "stand still"
    settings_type = StandSettings

    def behaviour(self, episode: Episode) -> BaseBehaviour:
        return _Still(episode)

    def criteria(self, trace: Trace, episode: Episode) -> list[Criterion]:
        return [
            Criterion.never("fell", trace.fallen),
            Criterion.never("ended before it began", len(trace.displacement) == 0),
            Criterion("distance wandered", _wandered(trace), "m", most=self.settings.radius),
        ]

    def metrics(self, trace: Trace, episode: Episode) -> dict[str, float]:
        return {"wandered_m": _wandered(trace)}


class _Still(BaseBehaviour):
    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        return Instruction(velocity=np.zeros(3))


def _wandered(trace: Trace) -> float:
    """Farthest that the base was from where it started [m]."""
    if len(trace.displacement) == 0:
        return 0.0
    offset = trace.displacement[:, :2] - trace.displacement[0, :2]
    return float(np.linalg.norm(offset, axis=1).max())

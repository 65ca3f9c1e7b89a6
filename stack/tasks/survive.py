"""Stay up, unconditionally: set in motion by a sentence, then no cost guides the motion and no sentence names it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Trace
from servoid.hw.contracts.world import Percept
from servoid.policy.text.captions import caption
from servoid.stack.tasks.walk import Walk, WalkSettings


@dataclass(frozen=True)
class SurviveSettings(WalkSettings):
    told: Annotated[
        float, "s at the start in which a sentence says how to walk: left alone at rest, a robot may rest on"
    ] = 3.0
    tolerance: Annotated[float | None, "m/s of mean error; none: not falling is enough"] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.told < 0.0:
            raise ValueError("told: must not be negative")


class Survive(Walk):
    """A planner is left to itself, for its weights are zero; policies that go by a velocity walk as in `walk`."""

    name = "survive"
    description = "stay up for a minute without guidance, from a walk that a sentence began"
    settings_type = SurviveSettings

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        instruction = super().instruct(tick, state, percept)
        told = tick * self.dt < self.settings.told
        return replace(instruction, text=caption(instruction.velocity) if told else "")

    @property
    def guides(self) -> bool:
        """By the velocity alone, there being nothing else in its instructions."""
        return self.settings.cost.twist

    def metrics(self, trace: Trace) -> dict[str, float]:
        return {"episode_ticks": float(len(trace.yaw)), **super().metrics(trace)}

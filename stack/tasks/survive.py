"""Stay up, unconditionally: no cost guides the motion, and no sentence names it."""

from __future__ import annotations

from dataclasses import replace

from hw.hal import Instruction, Percept, State, Trace
from stack.tasks.walk import Walk


class Survive(Walk):
    """A planner is left to itself, for its weights are zero; policies that go by a velocity walk as in `walk`."""

    name = "survive"
    description = "stay up for a minute without guidance"

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        return replace(super().instruct(tick, state, percept), text="")

    def metrics(self, trace: Trace) -> dict[str, float]:
        return {"episode_ticks": float(len(trace.yaw)), **super().metrics(trace)}

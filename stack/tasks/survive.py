"""Stay up, unconditionally: no cost guides the motion."""

from __future__ import annotations

from hw.hal import Trace
from stack.tasks.walk import Walk


class Survive(Walk):
    """A planner is left to itself, for its weights are zero; policies that go by a velocity walk as in `walk`."""

    name = "survive"
    description = "stay up for a minute without guidance"

    def metrics(self, trace: Trace) -> dict[str, float]:
        return {"episode_ticks": float(len(trace.yaw)), **super().metrics(trace)}

"""Stay up, unconditionally: set in motion by a sentence, then no cost guides the motion and no sentence names it."""

from __future__ import annotations

from dataclasses import dataclass, replace
from typing import Annotated

from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Episode, Trace
from servoid.hw.contracts.world import Percept
from servoid.hw.setting import Setting
from servoid.policy.text.captions import caption
from servoid.stack.tasks.base import BaseBehaviour, BaseTask
from servoid.stack.tasks.walk import Commands, FollowCommands, Walk, WalkSettings


@dataclass(frozen=True)
class SurviveSettings(WalkSettings):
    told: Annotated[
        float,
        Setting("time at the start in which a sentence says how to walk: at rest, a robot may stay so", "s", least=0),
    ] = 3.0
    tolerance: Annotated[
        float | None, Setting("largest mean velocity error of a success; none: not falling is enough", "m/s", above=0)
    ] = None


class Survive(Walk):
    """A planner is left to itself, for its weights are zero; policies that go by a velocity walk as in `walk`."""

    name = "survive"
    description = "stay up for a minute without guidance; a sentence starts the walk"
    settings_type = SurviveSettings
    guided_by_velocity_alone = True

    def behaviour(self, episode: Commands) -> BaseBehaviour:
        return _ToldAtFirst(episode, self.ticks(self.settings.every), self.settings.told, self)

    def metrics(self, trace: Trace, episode: Episode) -> dict[str, float]:
        return {"episode_ticks": float(len(trace.yaw)), **super().metrics(trace, episode)}


class _ToldAtFirst(FollowCommands):
    def __init__(self, episode: Commands, ticks: int, told: float, task: BaseTask) -> None:
        """`told`: s for which a sentence says how to walk."""
        super().__init__(episode, ticks)
        self._told, self._dt, self._top = told, task.dt, task.top

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        instruction = super().instruct(tick, state, percept)
        told = tick * self._dt < self._told
        return replace(instruction, text=caption(instruction.velocity, self._top) if told else "")

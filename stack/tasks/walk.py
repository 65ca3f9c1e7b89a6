"""Walk with a commanded velocity that changes in steps, with or without pushes; and `survive`: stay up, when a sentence
has set the robot in motion and no cost guides it any more."""

from __future__ import annotations

import math
from dataclasses import dataclass, field, replace
from typing import Annotated

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Criterion, Episode, Trace
from servoid.hw.contracts.world import Percept
from servoid.hw.setting import Range, Setting
from servoid.policy.references.gait import load_gait
from servoid.policy.text.captions import caption, motion_of
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, Settings, drawn_pushes
from servoid.stack.tasks.terms import metrics as measures

_COMPONENTS = ("vx", "vy", "yaw_rate")


@dataclass(frozen=True)
class WalkSettings(Settings):
    vx: Annotated[Range, Setting("forward; with one component given, the others are 0", "m/s", asks="forward")] = (
        -0.1,
        0.3,
    )
    vy: Annotated[Range, Setting("to the left", "m/s", asks="left")] = (-0.1, 0.1)
    yaw_rate: Annotated[Range, Setting("turning left", "rad/s", asks="turning")] = (-0.8, 0.8)
    every: Annotated[float, Setting("time between changes of the command", "s", above=0)] = 5.0
    push: Annotated[Range, Setting("size of each push, in a random direction", "m/s", least=0)] = (0.0, 0.0)
    push_every: Annotated[float, Setting("time between pushes", "s", above=0)] = 1.0
    cycle: Annotated[
        float, Setting("length of a gait cycle: velocity is averaged over it", "s", above=0, of="cycle")
    ] = field(default_factory=lambda: load_gait().cycle)
    tolerance: Annotated[
        float | None, Setting("largest mean velocity error of a success; none: not falling is enough", "m/s", above=0)
    ] = 0.1

    @staticmethod
    def completed(typed: dict[str, str]) -> dict[str, str]:
        """With some components given, the others are zero: `vx=0.6` walks straight ahead."""
        return {**dict.fromkeys(_COMPONENTS, "0"), **typed} if any(name in typed for name in _COMPONENTS) else typed


@dataclass(frozen=True, kw_only=True)
class WalkEpisode(Episode):
    commands: Array  # (changes, 3) m/s forward, m/s to the left, rad/s


class Walk(BaseTask):
    name = "walk"
    description = "walk with a commanded velocity that changes every few seconds"
    settings_type = WalkSettings

    def scenario(self, rng: np.random.Generator) -> WalkEpisode:
        """Draw all commands and pushes. The first push comes one interval after the start."""
        s = self.settings
        ranges = np.array([s.vx, s.vy, s.yaw_rate])
        commands = rng.uniform(ranges[:, 0], ranges[:, 1], size=(math.ceil(self.seconds / s.every), 3))
        pushes = drawn_pushes(rng, self.seconds, s.push, s.push_every, self.ticks(s.push_every))
        return WalkEpisode(commands=commands, pushes=pushes)

    def behaviour(self, episode: WalkEpisode) -> BaseBehaviour:
        return FollowCommands(episode, self.ticks(self.settings.every))

    def criteria(self, trace: Trace, episode: Episode) -> list[Criterion]:
        """Never fallen, and the velocity followed, as far as the run was long enough for a gait cycle that counts."""
        found = [
            Criterion.never("fell", trace.fallen),
            Criterion.never("ended before it began", len(trace.displacement) == 0),
        ]
        error, tolerance = measures.velocity_error(trace, self.settings.cycle), self.settings.tolerance
        if tolerance is not None and not math.isnan(error):
            found.append(Criterion("mean velocity error", error, "m/s", most=tolerance))
        return found

    def metrics(self, trace: Trace, episode: Episode) -> dict[str, float]:
        return {
            "velocity_error_mps": measures.velocity_error(trace, self.settings.cycle),
            "top_speed_mps": measures.top_speed(trace),
            "steady_speed_mps": measures.steady_speed(trace),
            "turning_rate_radps": measures.turning_rate(trace),
            "distance_m": measures.path_length(trace, self.settings.cycle),
        }


class FollowCommands(BaseBehaviour):
    """Asks for each command of the episode for `ticks` ticks, and for the last one from then on."""

    def __init__(self, episode: WalkEpisode, ticks: int) -> None:
        super().__init__(episode)
        self._ticks = ticks

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        commands = self.episode.commands
        return Instruction(velocity=commands[min(tick // self._ticks, len(commands) - 1)].copy())


_MOTION_SECONDS = 2.0  # over which a motion is told by its mean twist


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

    def behaviour(self, episode: WalkEpisode) -> BaseBehaviour:
        return _ToldAtFirst(episode, self.ticks(self.settings.every), self.settings.told, self)

    def metrics(self, trace: Trace, episode: Episode) -> dict[str, float]:
        """`motions`: how many different ones, of those that have a name, it moved by once it was left to itself."""
        alone = self.ticks(self.settings.told)
        seen = measures.mean_twists(trace, _MOTION_SECONDS)[math.ceil(alone * trace.dt / _MOTION_SECONDS) :]
        return {
            "episode_ticks": float(len(trace.yaw)),
            "motions": float(len(np.unique(motion_of(seen, self.top)))),
            **super().metrics(trace, episode),
        }


class _ToldAtFirst(FollowCommands):
    def __init__(self, episode: WalkEpisode, ticks: int, told: float, task: BaseTask) -> None:
        """`told`: s for which a sentence says how to walk."""
        super().__init__(episode, ticks)
        self._told, self._dt, self._top = told, task.dt, task.top

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        instruction = super().instruct(tick, state, percept)
        told = tick * self._dt < self._told
        return replace(instruction, text=caption(instruction.velocity, self._top) if told else "")

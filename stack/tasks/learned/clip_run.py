"""A clip that a policy imitates without being told when, as a task that is run: judged by time warping."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Criterion, Episode, Trace
from servoid.hw.contracts.world import Percept
from servoid.hw.robot.description import Robot, shipped_robot
from servoid.hw.setting import Setting
from servoid.policy.motion.library import find
from servoid.policy.motion.warping import seen_upright, warped_error
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, Settings
from servoid.stack.tasks.learned.clip import ImitatedClip

_EVERY = 2  # ticks between the frames that are compared


@dataclass(frozen=True)
class ClipSettings(Settings):
    seconds: Annotated[float, Setting("length of an episode", "s", above=0)] = 8.0
    clip: Annotated[str | None, Setting("clip that the policy was trained to imitate: a name, or a file")] = None
    most: Annotated[float, Setting("error of a success, as a share of the robot's standing height", above=0)] = 0.03


class RunClip(BaseTask):
    """The error is that of SMP, table 4: the distance of bodies from those of the clip, relative to the root, with
    time warped; here over the joints and the ends of the limbs, in the heading frame."""

    name = "clip"
    description = "imitate a clip again and again, by a policy that learned it"
    settings_type = ClipSettings

    def __init__(self, settings: ClipSettings, dt: float, robot: Robot | None = None) -> None:
        """Raises ConfigError for an unknown clip, or one that does not begin upright, as runs do."""
        super().__init__(settings, dt, robot)
        self._robot = robot or shipped_robot()
        self._clip = None if settings.clip is None else find(settings.clip, self._robot)
        if self._clip is not None and self._clip.about.begins != "upright":
            raise ConfigError(
                f"clip '{self._clip.name}' begins {self._clip.about.begins}, and a run begins standing: to get up, use "
                "task get-up with --recover"
            )
        self._low = settings.clip is not None and ImitatedClip(self._robot, settings.clip).grounded

    def scenario(self, rng: np.random.Generator) -> Episode:
        """Nothing is drawn. Raises ConfigError where no clip is named."""
        if self._clip is None:
            raise ConfigError("no clip is named: give --set clip=NAME (servoid motions list)")
        return Episode(low=self._low)

    def behaviour(self, episode: Episode) -> BaseBehaviour:
        return _Goes(episode)

    def criteria(self, trace: Trace, episode: Episode) -> list[Criterion]:
        error = self._error(trace) / self._robot.standing_height
        return [
            Criterion.never("fell", trace.fallen),
            Criterion("error by time warping, of the standing height", error, most=self.settings.most),
        ]

    def metrics(self, trace: Trace, episode: Episode) -> dict[str, float]:
        return {"clip_error_m": self._error(trace)}

    @cached_property
    def _limbs(self) -> Array:
        assert self._clip is not None
        return self._places(self._clip.joints[::_EVERY], self._clip.root_orientation[::_EVERY])

    def _error(self, trace: Trace) -> float:
        if self._clip is None or trace.joints is None or trace.orientation is None:
            return math.nan
        joints, orientation = trace.joints[::_EVERY], trace.orientation[::_EVERY]
        known = np.isfinite(joints).all(-1) & np.isfinite(orientation).all(-1)
        moved = self._places(joints[known], orientation[known])
        return warped_error(moved, self._limbs, self._clip.about.loop)

    def _places(self, joints: Array, orientation: Array) -> Array:
        """Of joints and of the ends of limbs `(ticks, points, 3)` m."""
        from servoid.sim.kinematics import joint_places, limbs_of

        ends = limbs_of(self._robot).ends(joints).reshape(len(joints), -1, 3)
        return seen_upright(np.concatenate([joint_places(self._robot, joints), ends], 1), orientation)


class _Goes(BaseBehaviour):
    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        """To do what it can."""
        return Instruction(velocity=np.zeros(3))

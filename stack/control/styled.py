"""The expert in a style: it walks by the style's gait, and does not see that the upper body does something else."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.robot.description import Robot
from servoid.policy.references.style import WalkingStyle
from servoid.stack.control.tracker import ExpertPolicy

_TAKEN_UP = 1.0  # s in which the upper body goes over into the style
_LOWERING = 0.04  # m/s


class StyledExpert(ExpertPolicy):
    """Walks one robot, or worlds of any leading `shape`. What it holds is where it would be, as the expert sees it."""

    def __init__(self, robot: Robot, style: WalkingStyle, checkpoint: str = "expert", shape: tuple[int, ...] = ()):
        """Raises CheckpointError where the tracker does not fit."""
        super().__init__(robot, checkpoint, shape, style)
        self._style, self._dt = style, robot.dt
        self._held, self._at, self._swing = style.held(robot)
        self._plain = np.broadcast_to(robot.home, (*shape, len(robot.joints))).copy()
        self._home, self._since, self._low = robot.home, np.zeros(shape), np.zeros(shape)

    def reset(self, where: Array | None, seeds: Array) -> None:
        super().reset(where, seeds)
        fresh = np.ones_like(self._since, bool) if where is None else where
        self._plain = np.where(fresh[..., None], self._home, self._plain)
        self._since, self._low = np.where(fresh, 0.0, self._since), np.where(fresh, 0.0, self._low)

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        gait, style = self._gait, self._style
        wave = np.sin(2.0 * np.pi * gait.phase) * gait.activity
        self._low = np.minimum(self._low + _LOWERING * self._dt, style.lower)
        gait.lowered = self._low + style.dip * 0.5 * (gait.activity + wave)
        hidden = replace(
            state,
            position=np.where(self._held, self._plain, state.position),
            joint_velocity=np.where(self._held, 0.0, state.joint_velocity),
        )
        told = replace(instruction, lower=gait.lowered)
        self._plain = super().act(hidden, np.where(self._held, self._plain, applied), told)
        self._since = self._since + self._dt
        share = np.minimum(self._since / _TAKEN_UP, 1.0)[..., None]
        upper = self._at + self._swing * wave[..., None]
        return np.where(self._held, self._home + share * (upper - self._home), self._plain)

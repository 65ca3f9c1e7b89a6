"""The scripted baseline: the analytic gait with gyro feedback."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.robot.description import Robot
from servoid.policy.references.gait import Gait, GaitSettings, GyroFeedback
from servoid.stack.control.base import BasePolicy

_NOW = np.array([0])


class GaitPolicy(BasePolicy):
    """Walks one robot, or worlds of any leading `shape`; by default as the robot's own gait is set."""

    def __init__(self, robot: Robot, shape: tuple[int, ...] = (), settings: GaitSettings | None = None) -> None:
        self._gait, self._feedback = Gait(robot, shape, settings), GyroFeedback(robot, settings)

    def reset(self, where: Array | None, seeds: Array) -> None:
        self._gait.reset(slice(None) if where is None else where)

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        self._gait.command(instruction.velocity, instruction.lower)
        target = self._gait.led(self._gait.frames(_NOW).position[..., 0, :])
        self._gait.advance()
        return self._feedback(target, state.angular_velocity)

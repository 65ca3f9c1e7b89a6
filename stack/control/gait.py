"""The scripted baseline: the analytic gait with gyro feedback."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Task
from servoid.hw.robot.description import Robot
from servoid.policy.references.gait import Gait, GyroFeedback
from servoid.stack.control.base import BasePolicy

_NOW = np.array([0])


class GaitPolicy(BasePolicy):
    def __init__(self, robot: Robot, task: Task, realtime: bool) -> None:
        del task, realtime  # a gait needs neither
        self._gait, self._feedback = Gait(robot), GyroFeedback(robot)

    def reset(self, seed: int) -> None:
        self._gait.reset()

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        self._gait.command(instruction.velocity)
        target = self._gait.frames(_NOW).position[0]
        self._gait.advance()
        return self._feedback(target, state.angular_velocity)

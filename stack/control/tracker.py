"""The learned tracker on the gait: the expert that makes the diffusion model's data."""

from __future__ import annotations

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Task
from servoid.hw.robot.description import Robot
from servoid.policy.checkpoint import resolve
from servoid.policy.mlp import Mlp
from servoid.policy.references.gait import Gait
from servoid.policy.tracker.observation import AHEAD, RESIDUAL, TrackerObservation
from servoid.stack.control.base import BasePolicy


class ExpertPolicy(BasePolicy):
    """Raises CheckpointError when the tracker of `checkpoint` does not fit the robot."""

    def __init__(self, robot: Robot, task: Task, realtime: bool, checkpoint: str = "expert") -> None:
        del task, realtime  # the tracker sees its reference alone, and answers within the tick
        self._gait, self._observation = Gait(robot), TrackerObservation(robot)
        self._tracker, _ = Mlp.load(resolve(checkpoint), "tracker", robot, self._observation.size)

    def reset(self, seed: int) -> None:
        self._gait.reset()
        self._observation.reset()

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        self._gait.command(instruction.velocity)
        frames = self._gait.frames(AHEAD)
        residual = self._tracker(self._observation(state, applied, frames))
        self._gait.advance()
        return frames.position[0] + RESIDUAL * residual

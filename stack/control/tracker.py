"""The learned tracker on the gait: the expert that makes the diffusion model's data."""

from __future__ import annotations

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.robot.description import Robot
from servoid.policy.checkpoint import resolve
from servoid.policy.mlp import Mlp
from servoid.policy.references.gait import Gait
from servoid.policy.tracker.observation import AHEAD, RESIDUAL, TrackerObservation
from servoid.stack.control.base import BasePolicy


class ExpertPolicy(BasePolicy):
    """Walks one robot, or worlds of any leading `shape`. Raises CheckpointError when the tracker does not fit."""

    def __init__(self, robot: Robot, checkpoint: str = "expert", shape: tuple[int, ...] = ()) -> None:
        self._gait, self._observation = Gait(robot, shape), TrackerObservation(robot, shape)
        self._tracker, _ = Mlp.load(resolve(checkpoint, robot), "tracker", robot, self._observation.size)

    def reset(self, where: Array | None, seeds: Array) -> None:
        self._gait.reset(slice(None) if where is None else where)
        self._observation.reset(where)

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        self._gait.command(instruction.velocity)
        frames = self._gait.frames(AHEAD)
        residual = self._tracker(self._observation(state, applied, frames))
        self._gait.advance()
        return frames.position[..., 0, :] + RESIDUAL * residual

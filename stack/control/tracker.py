"""A learned tracker on its references: on the gait it walks and makes the diffusion model's data, a clip it plays."""

from __future__ import annotations

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, Reference, State
from servoid.hw.robot.description import Robot
from servoid.policy.checkpoint import CheckpointError, resolve
from servoid.policy.references.gait import Gait
from servoid.policy.tracker.network import gait_of_tracker, load_tracker
from servoid.policy.tracker.observation import RESIDUAL, TrackerObservation
from servoid.stack.control.base import BasePolicy


class Tracker:
    """A trained network with what it remembers, of one robot or of worlds of any leading `shape`."""

    def __init__(
        self, robot: Robot, checkpoint: str = "expert", shape: tuple[int, ...] = (), *, clips: bool = False
    ) -> None:
        """Raises CheckpointError where the network does not fit, or `clips` are to be tracked and it knows none."""
        path = resolve(checkpoint, robot)
        self._network, knows = load_tracker(path, robot)
        if clips and not knows:
            raise CheckpointError(f"{path}: a tracker of the gait alone, and it is a clip that is to be tracked")
        self._observation = TrackerObservation(robot, shape, clips=knows)

    def reset(self, where: Array | None = None) -> None:
        """Forget, in the worlds `where` `(...,)` bool (default: all)."""
        self._observation.reset(where)

    def __call__(self, state: State, applied: Array, reference: Reference) -> Array:
        """Joint targets `(..., n_joints)` rad by which the next frame of `reference` is reached. Once a tick."""
        frames = reference.frames(self._observation.ahead)
        return frames.position[..., 0, :] + RESIDUAL * self._network(self._observation(state, applied, frames))


class ExpertPolicy(BasePolicy):
    """Walks one robot, or worlds of any leading `shape`, by the gait that the tracker learned on.

    Raises CheckpointError when the tracker does not fit.
    """

    def __init__(self, robot: Robot, checkpoint: str = "expert", shape: tuple[int, ...] = ()) -> None:
        gait = gait_of_tracker(resolve(checkpoint, robot), robot)
        self._gait, self._tracker = Gait(robot, shape, gait), Tracker(robot, checkpoint, shape)

    def reset(self, where: Array | None, seeds: Array) -> None:
        self._gait.reset(slice(None) if where is None else where)
        self._tracker.reset(where)

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        self._gait.command(instruction.velocity)
        target = self._gait.led(self._tracker(state, applied, self._gait))
        self._gait.advance()
        return target

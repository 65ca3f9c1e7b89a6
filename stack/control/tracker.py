"""A learned tracker on its references: on the gait it walks and makes the diffusion model's data, a clip it plays."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, Reference, State
from servoid.hw.robot.description import Robot
from servoid.policy.checkpoint import CheckpointError, resolve
from servoid.policy.motion.clip import Clip
from servoid.policy.references.either import GaitOrClip
from servoid.policy.references.gait import Gait
from servoid.policy.tracker.network import load_tracker
from servoid.policy.tracker.observation import RESIDUAL, TrackerObservation
from servoid.stack.control.base import BasePolicy
from servoid.stack.control.clip import check_entry


class Tracker:
    """A trained network with what it remembers, of one robot or of worlds of any leading `shape`."""

    def __init__(
        self, robot: Robot, checkpoint: str = "expert", shape: tuple[int, ...] = (), *, clips: bool = False
    ) -> None:
        """Raises CheckpointError where the network does not fit, or `clips` are to be tracked and it knows none."""
        path = resolve(checkpoint)
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
    """Walks one robot, or worlds of any leading `shape`. Raises CheckpointError when the tracker does not fit."""

    def __init__(self, robot: Robot, checkpoint: str = "expert", shape: tuple[int, ...] = ()) -> None:
        self._gait, self._tracker = Gait(robot, shape), Tracker(robot, checkpoint, shape)

    def reset(self, where: Array | None, seeds: Array) -> None:
        self._gait.reset(slice(None) if where is None else where)
        self._tracker.reset(where)

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        self._gait.command(instruction.velocity)
        target = self._tracker(state, applied, self._gait)
        self._gait.advance()
        return target


class TrackedClip(BasePolicy):
    """Plays a clip once, from the pose that the robot is in, and stands, or stays as it ends; keeps its balance.

    It begins after `stand_ticks` of standing. Of one robot, or of worlds of any leading `shape`. Raises ConfigError
    for a clip that does not begin upright, and CheckpointError where the tracker does not fit.
    """

    def __init__(
        self, robot: Robot, clip: Clip, checkpoint: str, shape: tuple[int, ...] = (), stand_ticks: int = 0
    ) -> None:
        check_entry(clip)
        self._stays, self._stand_ticks = clip.about.ends != "upright", stand_ticks
        self._tracker = Tracker(robot, checkpoint, shape, clips=True)
        self.reference = GaitOrClip(robot, [clip], shape)
        self._age = np.zeros(shape, int)  # ticks

    def reset(self, where: Array | None, seeds: Array) -> None:
        everywhere = np.ones_like(self._age, dtype=bool)
        chosen = everywhere if where is None else where
        self.reference.reset(slice(None) if where is None else where)
        self._age = np.where(chosen, 0, self._age)
        self._tracker.reset(where)

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        begins = self._age == self._stand_ticks
        if begins.any():
            self.reference.play(0, applied, begins)
        over = self.reference.ended
        if over.any() and not self._stays:
            self.reference.stand(applied, over)
        target = self._tracker(state, applied, self.reference)
        self.reference.advance()
        self._age = self._age + 1
        return target

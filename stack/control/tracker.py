"""A learned tracker on its references: on the gait it walks and makes the diffusion model's data, a clip it plays."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, Reference, State
from servoid.hw.robot.description import Robot
from servoid.policy.checkpoint import CheckpointError, resolve
from servoid.policy.references.gait import Gait
from servoid.policy.references.style import WalkingStyle
from servoid.policy.tracker.network import gait_of_tracker, load_tracker
from servoid.policy.tracker.observation import RESIDUAL
from servoid.stack.control.base import BasePolicy

LOOK = np.arange(0, 26)  # ticks ahead, a step with each foot, over which a plan is asked whether it walks
WALKS = 0.1  # of the top speeds, mean over that, from where on it does
LIFTED = 0.5  # contact below which a foot is in the air
UPRIGHT = 0.85  # of the standing height, which it keeps then
OVER_SECONDS = 0.2  # from one tracker to the other


class Tracker:
    """A trained network with what it remembers, of one robot or of worlds of any leading `shape`."""

    def __init__(
        self, robot: Robot, checkpoint: str = "expert", shape: tuple[int, ...] = (), *, clips: bool = False
    ) -> None:
        """Raises CheckpointError where the network does not fit, or `clips` are to be tracked and it knows none."""
        path = resolve(checkpoint, robot)
        self._network, self._observation = load_tracker(path, robot, shape)
        if clips and not self._observation.clips:
            raise CheckpointError(f"{path}: a tracker of the gait alone, and it is a clip that is to be tracked")

    def reset(self, where: Array | None = None) -> None:
        """Forget, in the worlds `where` `(...,)` bool (default: all)."""
        self._observation.reset(where)

    def __call__(self, state: State, applied: Array, reference: Reference) -> Array:
        """Joint targets `(..., n_joints)` rad by which the next frame of `reference` is reached. Once a tick."""
        frames = reference.frames(self._observation.ahead)
        seen = self._observation(state, applied, frames)
        return np.asarray(self._observation.base(frames) + RESIDUAL * self._network(seen))


class Followers:
    """What follows a plan: a tracker of any reference, and a tracker of the gait where the plan walks.

    Of one robot, or of worlds of any leading `shape`.

    A tracker that has learned clips is a poor walker: told to walk at 0.18 m/s it comes 0.4 times as far, and steps on
    the spot below 0.05 m/s, where the tracker of the gait goes as far as it is told, also on plans, which it never saw.
    """

    def __init__(self, robot: Robot, tracker: str, walker: str, shape: tuple[int, ...] = ()) -> None:
        """Raises CheckpointError where a network does not fit, or the first one knows no clips."""
        self._any = Tracker(robot, tracker, shape, clips=True)
        self._walker = Walker(robot, walker, shape) if walker else None

    def reset(self, where: Array | None = None) -> None:
        """Forget, in the worlds `where` `(...,)` bool (default: all)."""
        self._any.reset(where)
        if self._walker is not None:
            self._walker.reset(where)

    def __call__(self, state: State, applied: Array, reference: Reference) -> Array:
        """Joint targets `(..., n_joints)` rad by which the next frame of `reference` is reached. Once a tick."""
        target = self._any(state, applied, reference)
        return target if self._walker is None else self._walker(target, state, applied, reference)


class Walker:
    """A tracker of the gait that takes over from another one, little by little, where a plan walks; of one robot, or of
    worlds of any leading `shape`."""

    def __init__(self, robot: Robot, checkpoint: str, shape: tuple[int, ...] = ()) -> None:
        """Raises CheckpointError where the network does not fit."""
        self._tracker, self._robot = Tracker(robot, checkpoint, shape), robot
        self.share, self._step = np.zeros(shape), robot.dt / OVER_SECONDS

    def reset(self, where: Array | None = None) -> None:
        """Forget, in the worlds `where` `(...,)` bool (default: all)."""
        self.share = np.where(True if where is None else where, 0.0, self.share)
        self._tracker.reset(where)

    def __call__(self, target: Array, state: State, applied: Array, reference: Reference) -> Array:
        """Joint targets `(..., n_joints)` rad, where the other one has `target`. Once a tick."""
        walking = self._tracker(state, applied, reference)  # at every tick, so that what it remembers has no gap
        self.share = np.clip(self.share + np.where(walks(reference, self._robot), self._step, -self._step), 0.0, 1.0)
        share = self.share[..., None]
        return np.asarray(share * walking + (1.0 - share) * target)


def walks(reference: Reference, robot: Robot) -> Array:
    """Whether a reference goes anywhere, or turns, step by step, upright `(...,)`.

    What keeps a foot on the ground is no walk, however it moves: a punch turns the trunk, a kick leans to the side.
    """
    frames = reference.frames(LOOK)
    twist = np.concatenate([frames.velocity, frames.yaw_rate[..., None]], -1).mean(-2) / robot.walking.scale
    upright = frames.height.min(-1) >= UPRIGHT * robot.standing_height
    steps = (frames.contact.min(-2) < LIFTED).all(-1)
    return np.asarray(upright & steps & (np.linalg.norm(twist, axis=-1) > WALKS))


class ExpertPolicy(BasePolicy):
    """Walks one robot, or worlds of any leading `shape`, by the gait that the tracker learned on.

    Raises CheckpointError when the tracker does not fit.
    """

    def __init__(
        self, robot: Robot, checkpoint: str = "expert", shape: tuple[int, ...] = (), style: WalkingStyle | None = None
    ) -> None:
        gait = gait_of_tracker(resolve(checkpoint, robot), robot)
        if style is not None:
            gait = style.changed(gait)
        self._gait, self._tracker = Gait(robot, shape, gait), Tracker(robot, checkpoint, shape)

    @property
    def gait(self) -> Gait:
        """What it follows."""
        return self._gait

    def reset(self, where: Array | None, seeds: Array) -> None:
        self._gait.reset(slice(None) if where is None else where)
        self._tracker.reset(where)

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        self._gait.command(instruction.velocity, instruction.lower)
        if self._gait.lowered.any():  # it has only seen walks upright, and would push itself up
            displacement = state.displacement.copy()
            displacement[..., 2] += self._gait.lowered
            state = replace(state, displacement=displacement)
        target = self._gait.led(self._tracker(state, applied, self._gait))
        self._gait.advance()
        return target

"""What follows a plan: a tracker of any reference, and a tracker of the gait where the plan walks.

A tracker that has learned clips is a poor walker: told to walk at 0.18 m/s it comes 0.4 times as far, and steps on the
spot below 0.05 m/s, where the tracker of the gait goes as far as it is told, also on plans, which it never saw.
"""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Reference, State
from servoid.hw.robot.description import Robot
from servoid.stack.control.tracker import Tracker

LOOK = np.arange(0, 26, 5)  # ticks ahead over which a plan is asked whether it walks
WALKS = 0.1  # of the top speeds, mean over that, from where on it does
UPRIGHT = 0.85  # of the standing height, which it keeps then
OVER_SECONDS = 0.2  # from one tracker to the other


class Followers:
    """Both trackers, of one robot or of worlds of any leading `shape`."""

    def __init__(self, robot: Robot, tracker: str, walker: str, shape: tuple[int, ...] = ()) -> None:
        """Raises CheckpointError where a network does not fit, or the first one knows no clips."""
        self._any = Tracker(robot, tracker, shape, clips=True)
        self._walker = Tracker(robot, walker, shape) if walker else None
        self._robot, self._share = robot, np.zeros(shape)
        self._step = robot.dt / OVER_SECONDS

    def reset(self, where: Array | None = None) -> None:
        """Forget, in the worlds `where` `(...,)` bool (default: all)."""
        self._share = np.where(True if where is None else where, 0.0, self._share)
        self._any.reset(where)
        if self._walker is not None:
            self._walker.reset(where)

    def __call__(self, state: State, applied: Array, reference: Reference) -> Array:
        """Joint targets `(..., n_joints)` rad by which the next frame of `reference` is reached. Once a tick."""
        target = self._any(state, applied, reference)
        if self._walker is None:
            return target
        walking = self._walker(state, applied, reference)  # at every tick, so that what it remembers has no gap
        self._share = np.clip(self._share + np.where(walks(reference, self._robot), self._step, -self._step), 0.0, 1.0)
        share = self._share[..., None]
        return np.asarray(share * walking + (1.0 - share) * target)


def walks(reference: Reference, robot: Robot) -> Array:
    """Whether a reference goes anywhere, or turns, upright `(...,)`."""
    frames = reference.frames(LOOK)
    twist = np.concatenate([frames.velocity, frames.yaw_rate[..., None]], -1).mean(-2) / robot.walking.scale
    upright = frames.height.min(-1) >= UPRIGHT * robot.standing_height
    return np.asarray(upright & (np.linalg.norm(twist, axis=-1) > WALKS))

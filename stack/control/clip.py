"""A clip as a controller, through the guard, on whatever body there is: its goals alone, or followed by a tracker."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import Clip
from servoid.policy.references.clip import ClipReference
from servoid.policy.references.either import GaitOrClip
from servoid.stack.control.base import BasePolicy
from servoid.stack.control.tracker import Tracker
from servoid.stack.safety.balance import Balance, Feedback

HOLD_SECONDS = 0.3  # of a tracked clip's last frame, before the robot goes home
SETTLE_SECONDS = 1.2  # from the end of a tracked clip until it is over
_NOW = np.array([0])


class ClipPolicy(BasePolicy):
    """Plays a clip once, from the pose that the robot is in, and stays in its last pose; of one robot or of `shape`.

    Only what `balance` says answers a base that tilts; without, what the robot does between its feet and the ground is
    left to the clip. Raises ConfigError for a clip that leaves the joint ranges.
    """

    def __init__(self, robot: Robot, clip: Clip, shape: tuple[int, ...] = (), balance: Balance | None = None) -> None:
        self._reference = ClipReference(robot, [clip], shape)
        self._gains = None if balance is None else balance.gains
        self._feedback = Feedback(robot)
        self._entering = np.ones(shape, bool)

    def reset(self, where: Array | None, seeds: Array) -> None:
        everywhere = np.ones_like(self._entering)
        self._entering = self._entering | (everywhere if where is None else where)

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        if self._entering.any():
            self._reference.play(0, where=self._entering)
            self._reference.enter(np.asarray(applied, dtype=float), self._entering)
            self._entering = np.zeros_like(self._entering)
        target = self._reference.frames(_NOW).position[..., 0, :]
        self._reference.advance()
        if self._gains is None:
            return target
        return self._feedback(target, state.gravity, state.angular_velocity, self._gains)

    @property
    def ended(self) -> bool:
        """Whether the clip is over in every world."""
        return not self._entering.any() and bool(self._reference.ended.all())


class TrackedClip(BasePolicy):
    """Follows a clip once, with a tracker that keeps its balance; of one robot or of `shape`, which is the tracker's.

    A clip that ends upright is over once the tracker has stood for a while, for as it ends the robot still moves.
    Raises ConfigError for a clip that leaves the joint ranges.
    """

    def __init__(self, robot: Robot, clip: Clip, tracker: Tracker, shape: tuple[int, ...] = ()) -> None:
        self._tracker, self._reference = tracker, GaitOrClip(robot, [clip], shape)
        self._stands = clip.about.ends == "upright"
        self._hold, self._settle = (round(seconds * robot.rate) for seconds in (HOLD_SECONDS, SETTLE_SECONDS))
        self._entering = np.ones(shape, bool)
        self._over = np.zeros(shape, int)  # ticks since the clip ended

    def reset(self, where: Array | None, seeds: Array) -> None:
        everywhere = np.ones_like(self._entering)
        begins = everywhere if where is None else where
        self._entering = self._entering | begins
        self._over = np.where(begins, 0, self._over)
        self._tracker.reset(where)

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        if self._entering.any():
            self._reference.play(0, np.asarray(applied, dtype=float), self._entering)
            self._entering = np.zeros_like(self._entering)
        over = ~self._reference.on_clip | self._reference.ended
        self._over = np.where(over, self._over + 1, 0)
        if self._stands and (stand := self._reference.ended & (self._over > self._hold)).any():
            self._reference.stand(applied, stand)
        target = self._tracker(state, applied, self._reference)
        self._reference.advance()
        return target

    @property
    def ended(self) -> bool:
        """Whether the clip is over in every world, and the robot has come to a stand where it ends upright."""
        return bool((self._over > (self._settle if self._stands else 0)).all())

"""Gets up, from however the robot lies, and goes home: by a learned policy, or by a clip, followed or open loop.

It proposes targets as a policy does. A policy has the first try, where one is shipped for the robot; later tries, and
robots without one, go by a clip: followed by a tracker, where one is shipped, or else open loop. Which way the robot
lies, gravity says; on its side the nearer of both. Going to the clip's first pose often rolls it over, so that is
looked at again.
"""

from __future__ import annotations

from collections.abc import Iterator
from pathlib import Path

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import State
from servoid.hw.robot.description import Robot
from servoid.policy.checkpoint import CHECKPOINTS, read_header
from servoid.policy.motion.clip import Clip
from servoid.policy.motion.library import Library
from servoid.policy.references.clip import BLEND_SHARE, ClipReference
from servoid.policy.references.either import GaitOrClip
from servoid.policy.rising.lead import CLIPS
from servoid.policy.rising.policy import RisingPolicy
from servoid.stack.control.tracker import Tracker
from servoid.stack.log.provenance import sha256
from servoid.stack.safety.min_jerk import MIN_JERK_PEAK, MinJerk
from servoid.stack.safety.recovery import Recovery

POLICY = "get_up"  # name of the shipped checkpoint
SETTLE_SECONDS = 0.5  # in a clip's first pose: clips were recorded from there, at rest
STAND_SECONDS = 1.5  # that the robot has to come to a stand in when the clip is over
HOME_SECONDS = 2.0  # the same, when it is home
RATE = 1.6  # at which a tracker gets up, of the clip's own speed
LEARNED_SECONDS = 6.0  # that a learned policy has; it begins anew by itself where it falls meanwhile
ROLLED_SHARE = 0.15  # of a clip, in which the robot may still roll over to its other side


class GetUp:
    """One robot's way up. `begin` starts a try; `failed` says why one is over."""

    def __init__(self, robot: Robot, clips: tuple[Clip, Clip]) -> None:
        """`clips`: from lying on the front and on the back. Raises ConfigError where they do not fit."""
        self._robot, self._clips = robot, clips
        self._reference = ClipReference(robot, clips)
        self._ahead = np.zeros(1, int)
        self.failed: str | None = None
        self._way: Iterator[Array] | None = None
        self._state: State
        self._applied: Array

    def begin(self) -> None:
        """Start a try, from however the robot lies at the next call of `act`."""
        self.failed, self._way = None, None

    def act(self, state: State, applied: Array, recovery: Recovery) -> Array | None:
        """Joint targets `(n_joints,)` rad for the next tick; None when the try is over, and `failed` says why.

        `applied` is what the guard sent last, `recovery` what it sees of whether the robot stands.
        """
        self._state, self._applied = state, applied
        self._way = self._way or self._rise(recovery)
        return next(self._way, None)

    def _rise(self, recovery: Recovery) -> Iterator[Array]:
        side = self._side()
        for _ in CLIPS:
            yield from self._go(self._clips[side].joints[0], BLEND_SHARE * self._robot.limits.joint_speed)
            yield from self._wait(SETTLE_SECONDS)
            if self._side() == side:
                break
            side = self._side()  # rolled over; from its other side there is no third
        self._reference.play(side)
        self._reference.enter(self._applied)
        while not self._reference.ended:
            yield self._reference.frames(self._ahead).position[0]
            self._reference.advance()
        for target in self._wait(STAND_SECONDS):
            if recovery.stands:
                break
            yield target
        else:
            self.failed = f"'{CLIPS[side]}' did not end on its feet and still"
            return
        yield from self._go(self._robot.home, self._robot.limits.homing_speed)
        yield from self._wait(HOME_SECONDS)
        self.failed = "it stood up, and did not come to a stand at home"

    def _side(self) -> int:
        """0: on its front, or nearer to that; 1: on its back. The base's x axis, ahead, points down or up."""
        return 0 if float(self._state.gravity[0]) >= 0.0 else 1

    def _go(self, pose: Array, speed: float) -> Iterator[Array]:
        """To a pose, no joint faster than `speed` [rad/s]."""
        seconds = MIN_JERK_PEAK * float(np.abs(pose - self._applied).max()) / speed
        way = MinJerk(self._applied, pose, int(np.ceil(seconds * self._robot.rate)))
        while not way.done:
            yield way.next()

    def _wait(self, seconds: float) -> Iterator[Array]:
        for _ in range(round(seconds * self._robot.rate)):
            yield self._applied


class TrackedGetUp(GetUp):
    """Gets up with a tracker: it needs no rest in the clip's first pose, keeps its balance, and stands by the gait."""

    def __init__(self, robot: Robot, clips: tuple[Clip, Clip], tracker: Tracker) -> None:
        """Raises ConfigError where the clips do not fit."""
        super().__init__(robot, clips)
        self._tracker, self._either = tracker, GaitOrClip(robot, clips)

    def _rise(self, recovery: Recovery) -> Iterator[Array]:
        reference, everywhere = self._either, np.ones((), bool)
        self._tracker.reset()
        side = self._side()
        reference.play(side, self._applied, everywhere, rate=RATE)
        rolled = False
        while not reference.ended:
            # While it comes to the first pose it may roll over: once that is answered, twice it has no end.
            if not rolled and reference.clip.time < ROLLED_SHARE * self._clips[side].ticks and self._side() != side:
                rolled, side = True, self._side()
                reference.play(side, self._applied, everywhere, rate=RATE)
            yield self._follow()
        for _ in range(round(SETTLE_SECONDS * self._robot.rate)):
            yield self._follow()
        reference.stand(self._applied, everywhere)
        for _ in range(round((STAND_SECONDS + HOME_SECONDS) * self._robot.rate)):
            yield self._follow()
        self.failed = (
            "it stood up, and did not come to a stand at home"
            if recovery.stands
            else f"'{CLIPS[side]}' did not end on its feet and still"
        )

    def _follow(self) -> Array:
        target = self._tracker(self._state, self._applied, self._either)
        self._either.advance()
        return target


class LearnedGetUp(GetUp):
    """Gets up with a policy in the first try of a fall, and in later ones as `otherwise` does."""

    def __init__(self, robot: Robot, clips: tuple[Clip, Clip], policy: RisingPolicy, otherwise: GetUp) -> None:
        """Raises ConfigError where the clips do not fit."""
        super().__init__(robot, clips)
        self._policy, self._otherwise = policy, otherwise

    def begin(self) -> None:
        super().begin()
        self._otherwise.begin()

    def act(self, state: State, applied: Array, recovery: Recovery) -> Array | None:
        if recovery.tries <= 1:
            return super().act(state, applied, recovery)
        target = self._otherwise.act(state, applied, recovery)
        self.failed = self._otherwise.failed
        return target

    def _rise(self, recovery: Recovery) -> Iterator[Array]:
        self._policy.reset()
        for _ in range(round(LEARNED_SECONDS * self._robot.rate)):
            yield self._policy(self._state, self._applied)
        self.failed = (
            "it stood up, and did not come to a stand at home"
            if recovery.stands
            else f"the learned policy did not end on its feet and still within {LEARNED_SECONDS:g} s"
        )


def get_up(robot: Robot, checkpoints: Path = CHECKPOINTS) -> GetUp:
    """By the policy that gets up among `checkpoints`, where it is of this robot; by the clips of the shipped library,
    and the tracker where it knows clips of this robot.

    Raises ConfigError for a robot that has no clips, or cannot know how it lies.
    """
    if robot.imu.kind == "none":
        raise ConfigError(f"--recover: {robot.name} has no IMU, so it cannot know that it has fallen: drop --recover")
    try:
        library = Library(robot)
        front, back = (library[name] for name in CLIPS)
        clips = front, back
        tracker, policy = (_found(name, robot, checkpoints) for name in ("tracker", POLICY))
        by_clips = GetUp(robot, clips)
        if tracker is not None:
            by_clips = TrackedGetUp(robot, clips, Tracker(robot, str(tracker), clips=True))
        return by_clips if policy is None else LearnedGetUp(robot, clips, RisingPolicy(robot, policy, clips), by_clips)
    except ConfigError as error:
        names = " and ".join(f"'{name}'" for name in CLIPS)
        raise ConfigError(
            f"--recover: {robot.name} has no clips {names} to get up by: drop --recover ({error})"
        ) from error


def _found(name: str, robot: Robot, checkpoints: Path) -> Path | None:
    """The robot's own checkpoint, or the shipped one where that is of this robot."""
    own, shipped = (folder / f"{name}.safetensors" for folder in (Path(robot.folder), checkpoints))
    if own.is_file():
        return own
    return shipped if shipped.is_file() and read_header(shipped)["robot"] == robot.name else None


def fingerprints(robot: Robot, checkpoints: Path = CHECKPOINTS) -> dict[str, str | None]:
    """Hashes of the clips' files, by their names, of a robot that has them, of the tracker that follows them, and of
    the policy that gets up."""
    library = Library(robot)
    clips = {name: sha256(library.path(name)) for name in CLIPS}
    networks = {name: _found(name, robot, checkpoints) for name in ("tracker", POLICY)}
    return {**clips, **{name: sha256(path) for name, path in networks.items() if path is not None}}

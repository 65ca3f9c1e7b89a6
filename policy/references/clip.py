"""Clips as a reference: each world plays one of them, at a rate of its own, from a pose that blends in."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Reference, ReferenceFrames
from servoid.hw.geometry import headed, turned, yaw_of
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import Clip, smooth, velocities

BLEND_SHARE = 0.5  # of the speed that the guard allows, that blending in may take
WAIT_SHARE = 0.8  # the same where the clip waits meanwhile: nothing is added to its own speed


class ClipReference(Reference):
    """One or more clips; arrays have any leading dimensions `shape`, and each world a clip, a time in it and a rate.

    A loop goes on from its end, its place and heading carried along. Another clip holds its last frame. `enter` begins
    a clip in the pose that the robot is in: what it differs by fades out, no faster than the guard allows. One that
    does not begin upright waits in its first frame for that long: limbs must be where they are to push.
    """

    def __init__(self, robot: Robot, clips: Sequence[Clip], shape: tuple[int, ...] = ()) -> None:
        """Raises ConfigError without a clip, or where a clip leaves the joint ranges."""
        if not clips:
            raise ConfigError("a clip reference needs at least one clip")
        for clip in clips:
            if clip.joints.shape[1] != len(robot.joints):
                raise ConfigError(
                    f"clip '{clip.name}' has {clip.joints.shape[1]} joints, but {robot.name} has {len(robot.joints)}"
                )
            beyond = np.maximum(robot.lower - clip.joints, clip.joints - robot.upper).max(0)
            if (beyond > 1e-6).any():
                joint = int(beyond.argmax())
                raise ConfigError(
                    f"clip '{clip.name}': {robot.names[joint]} goes {beyond[joint]:.2f} rad beyond the robot's range"
                )
        self.robot, self.clips = robot, tuple(clips)
        longest = max(clip.ticks for clip in clips)
        self._ticks = np.array([clip.ticks for clip in clips])
        self._loop = np.array([clip.about.loop for clip in clips])
        self._waits = np.array([clip.about.begins != "upright" for clip in clips])

        def table(arrays: list[Array]) -> Array:  # what is beyond a clip's end repeats its last frame
            return np.stack([np.concatenate([a, np.repeat(a[-1:], longest - len(a), 0)]) for a in arrays])

        self._joints = table([clip.joints for clip in clips])
        self._place = table([clip.root_position for clip in clips])
        self._turn = table([_continuous(clip.root_orientation) for clip in clips])
        self._contact = table([clip.contact for clip in clips])
        rates = [velocities(clip, robot.dt) for clip in clips]
        yaws = [np.unwrap(yaw_of(clip.root_orientation)) for clip in clips]
        self._yaw = table(yaws)
        self._rate_of_joints = table([rate[0] for rate in rates])
        self._velocity = table([turned(rate[1], -yaw)[:, :2] for rate, yaw in zip(rates, yaws, strict=True)])
        self._yaw_rate = table([rate[2][:, 2] for rate in rates])
        self.clip = np.zeros(shape, int)
        self.time = np.zeros(shape)  # ticks into the clip, fractions too
        self.rate = np.ones(shape)  # of playing: 2 is twice as fast
        self._offset = np.zeros((*shape, len(robot.joints)))  # of the pose that was entered from
        self._since, self._blend = np.ones(shape), np.ones(shape)  # ticks since it was entered; that it takes

    def reset(self, where: Array | slice = slice(None)) -> None:
        """Begin the same clips anew, without a blend."""
        for array, value in ((self.time, 0.0), (self._offset, 0.0), (self._since, 1.0), (self._blend, 1.0)):
            array[() if array.ndim == 0 or not self.clip.ndim else where] = value

    def play(
        self, clip: Array | int, *, time: Array | float = 0.0, rate: Array | float = 1.0, where: Array | None = None
    ) -> None:
        """Play clips by their index, from `time` [ticks] on, in the worlds `where` (default: all), without a blend."""
        chosen = ... if where is None or not self.clip.ndim else where
        self.clip[chosen], self.time[chosen], self.rate[chosen] = clip, time, rate
        self._offset[chosen], self._since[chosen], self._blend[chosen] = 0.0, 1.0, 1.0

    def enter(self, joints: Array, where: Array | None = None) -> None:
        """Begin in the pose `joints` `(..., n_joints)` rad: what it differs from the clip by fades out."""
        chosen = ... if where is None or not self.clip.ndim else where
        offset = joints - self._joints[self.clip, self._index(self.time)[0]]
        # A minimum-jerk blend is at its quickest 1.875 times as fast as its mean.
        share = np.where(self._waits[self.clip], WAIT_SHARE, BLEND_SHARE)
        speed = share * self.robot.limits.joint_speed * self.robot.dt
        ticks = np.maximum(np.ceil(1.875 * np.abs(offset).max(-1) / speed), 1.0)
        self._offset[chosen], self._blend[chosen] = offset[chosen], ticks[chosen]
        self._since[chosen] = 0.0

    @property
    def ended(self) -> Array:
        return ~self._loop[self.clip] & (self.time >= self._ticks[self.clip] - 1)

    @property
    def phase(self) -> Array:
        """How far each world is in its clip `(...)`: 0 at its first frame, 1 at its last."""
        last = self._ticks[self.clip] - 1.0
        return np.where(self._loop[self.clip], self.time % last, np.minimum(self.time, last)) / last

    @property
    def _wait(self) -> Array:
        """Ticks that each world still waits for `(...)`."""
        return np.where(self._waits[self.clip], np.maximum(self._blend - self._since, 0.0), 0.0)

    def advance(self) -> None:
        # Of one robot a sum is a number, and could not be set again.
        self.time = np.asarray(self.time + self.rate * (self._wait < 1.0))
        self._since = np.asarray(self._since + 1.0)

    def _index(self, time: Array) -> tuple[Array, Array]:
        """Frame before each time of a clip and how far on the next one is, of the present clips."""
        clip = self.clip.reshape(self.clip.shape + (1,) * (np.ndim(time) - self.clip.ndim))
        last = self._ticks[clip] - 1.0
        within = np.where(self._loop[clip], time % last, np.clip(time, 0.0, last))
        low = np.minimum(np.floor(within).astype(int), (last - 1).astype(int))
        return low, within - low

    def frames(self, ahead: Array) -> ReferenceFrames:
        wait = np.floor(self._wait)[..., None]
        passed = np.where(wait > 0.0, np.maximum(ahead - wait, 0.0), ahead)
        time = self.time[..., None] + passed * self.rate[..., None]
        clip = np.broadcast_to(self.clip[..., None], time.shape)
        at = self._reader(time)
        still = ~self._loop[clip] & (time >= self._ticks[clip] - 1)
        moving = np.where(still | (ahead < wait), 0.0, self.rate[..., None])
        fading = np.clip((self._since[..., None] + np.asarray(ahead)) / self._blend[..., None], 0.0, 1.0)
        offset = (1.0 - smooth(fading))[..., None] * self._offset[..., None, :]
        slope = 30.0 * fading**2 * (1.0 - fading) ** 2 / (self._blend[..., None] * self.robot.dt)
        place, yaw = self._travelled(time)
        here, facing = self._travelled(self.time[..., None])
        root = turned(place - here, -facing)
        root[..., 2] = place[..., 2]
        upright = headed(_unit(at(self._turn)), -at(self._yaw))
        return ReferenceFrames(
            position=np.clip(at(self._joints) + offset, self.robot.lower, self.robot.upper),
            joint_velocity=at(self._rate_of_joints) * moving[..., None] - slope[..., None] * self._offset[..., None, :],
            velocity=at(self._velocity) * moving[..., None],
            yaw_rate=at(self._yaw_rate) * moving,
            height=place[..., 2],
            root_position=root,
            root_orientation=headed(upright, yaw - facing),
            contact=at(self._contact),
        )

    def _reader(self, time: Array) -> Callable[[Array], Array]:
        """What reads tables `(clips, ticks, ...)` at times `(..., k)` of the present clips, between frames linearly."""
        clip = np.broadcast_to(self.clip[..., None], time.shape)
        low, share = self._index(time)

        def at(table: Array) -> Array:
            part = share.reshape(share.shape + (1,) * (table.ndim - 2))
            return table[clip, low] + part * (table[clip, low + 1] - table[clip, low])

        return at

    def _travelled(self, time: Array) -> tuple[Array, Array]:
        """Place `(..., k, 3)` and heading `(..., k)` at times `(..., k)`, with what rounds of a loop have added."""
        at, clip = self._reader(time), np.broadcast_to(self.clip[..., None], time.shape)
        last = self._ticks[clip] - 1
        rounds = np.where(self._loop[clip], np.floor(time / last), 0.0)
        begin, turn = self._place[clip, 0], self._yaw[clip, last] - self._yaw[clip, 0]
        step = self._place[clip, last] - begin
        step[..., 2] = 0.0
        # Each round goes on from where the last one ended, turned as far again: the chord of so many turned steps.
        sine = np.sin(turn / 2)
        curved = np.abs(sine) > 1e-9
        gain = np.where(curved, np.sin(rounds * turn / 2) / np.where(curved, sine, 1.0), rounds)
        moved = gain[..., None] * turned(step, (rounds - 1.0) * turn / 2)
        return turned(at(self._place) - begin, rounds * turn) + begin + moved, at(self._yaw) + rounds * turn


def _continuous(quaternions: Array) -> Array:
    """Quaternions `(ticks, 4)` whose sign does not jump from one frame to the next."""
    flips = np.where((quaternions[1:] * quaternions[:-1]).sum(-1) < 0.0, -1.0, 1.0)
    return quaternions * np.concatenate([[1.0], np.cumprod(flips)])[:, None]


def _unit(quaternions: Array) -> Array:
    return quaternions / np.linalg.norm(quaternions, axis=-1, keepdims=True)

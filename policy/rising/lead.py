"""What leads a policy that gets up: the clips that get up, at the speed that the policy asks for.

Which clip, gravity says as it begins. It waits for joints that are still on their way, and begins anew, from either
side, where the robot does not lie or stand as the clip does: it rolled over, or fell again.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import up_vector
from servoid.hw.robot.description import Robot
from servoid.hw.robot.mirror import Mirror
from servoid.policy.motion.clip import Clip
from servoid.policy.priors.goals import SeenGoal, nothing

CLIPS = ("get-up-front", "get-up-back")
SLOWEST, FASTEST = 0.3, 3.0  # of a clip's own speed
_HOMING = 20  # ticks from a clip's end to home
_ASTRAY = 1.0  # squared error of gravity, seen from the base: 60 degrees
_PATIENCE = 0.3  # s of that until the clip begins anew


@dataclass(frozen=True)
class LeadPace:
    """How fast the lead goes. A policy that was trained with one needs it."""

    rate: float = 1.4  # of a clip's own speed, for an action of zero
    exponent: float = 1.0  # of e, by which an action of one is faster
    behind: float = 0.8  # rad that a joint's goal may be behind what is wanted until the lead slows down,
    waits: float = 1.8  # and until it waits


PACE = LeadPace()


class Rising:
    """Of one robot, or worlds of any leading `shape`."""

    def __init__(self, robot: Robot, clips: Sequence[Clip], shape: tuple[int, ...] = (), pace: LeadPace = PACE) -> None:
        """`clips`: from lying on the front, and on the back."""
        self.pace = pace
        longest = max(clip.ticks for clip in clips) + _HOMING
        self._home, self._rate, self._shape = robot.home, robot.rate, shape
        self._lower, self._upper = robot.lower + robot.limits.margin, robot.upper - robot.limits.margin
        self._last = np.array([clip.ticks - 1 + _HOMING for clip in clips])

        def table(arrays: list[Array]) -> Array:
            return np.stack([np.concatenate([a, np.repeat(a[-1:], longest + 1 - len(a), 0)]) for a in arrays])

        share = np.arange(1, _HOMING + 1)[:, None] / _HOMING
        ways = [clip.joints[-1] + share * (robot.home - clip.joints[-1]) for clip in clips]
        self._joints = table([np.concatenate([clip.joints, way]) for clip, way in zip(clips, ways, strict=True)])
        self._gravity = table([-up_vector(clip.root_orientation) for clip in clips])
        self.side = np.zeros(shape, int)
        self.time = np.zeros(shape)  # ticks into the clip, fractions too
        self._astray = np.zeros(shape, int)  # ticks in a row
        joints = Mirror.joints(robot)
        mirror = Mirror.join(joints, Mirror.SCALAR, Mirror.SCALAR, Mirror.SCALAR)
        self.goal = SeenGoal("rise", len(mirror.index), mirror, nothing, odometry=False)

    def begin(self, where: Array, gravity: Array, side: Array | None = None, time: Array | float = 0.0) -> None:
        """Begin in the worlds `where` `(...,)` bool: as they lie by `gravity` `(..., 3)`, or in a clip from `time`."""
        lies = np.where(gravity[..., 0] >= 0.0, 0, 1)
        known = lies if side is None else np.where(side < 0, lies, side)
        self.side = np.where(where, known, self.side)
        self.time = np.where(where, time, self.time)
        self._astray = np.where(where, 0, self._astray)

    @property
    def target(self) -> Array:
        """Joint targets of the clips `(..., n_joints)` rad."""
        return self._at(self._joints)

    @property
    def seen(self) -> Array:
        """What the policy sees of it `(..., goal.size)`: the targets, how far the clip is, which it is, and whether it
        is over."""
        share = self.time / self._last[self.side]
        return np.concatenate(
            [self.target - self._home, np.stack([share, 2.0 * self.side - 1.0, share >= 1.0], -1)], -1
        )

    def advance(self, faster: Array, gravity: Array, wanted: Array, applied: Array) -> None:
        """Go on by a tick as fast as an action `faster` `(...,)` asks, after one in which joint targets `wanted` became
        `applied` `(..., n_joints)` rad."""
        pace = self.pace
        behind = np.abs(applied - np.clip(wanted, self._lower, self._upper)).max(-1)
        free = np.clip((pace.waits - behind) / (pace.waits - pace.behind), 0.0, 1.0)
        rate = np.clip(pace.rate * np.exp(pace.exponent * faster), SLOWEST, FASTEST)
        self.time = np.minimum(self.time + rate * free, self._last[self.side])
        off = ((gravity - self._at(self._gravity)) ** 2).sum(-1) > _ASTRAY
        self._astray = np.where(off, self._astray + 1, 0)
        lost = self._astray > _PATIENCE * self._rate
        if np.any(lost):
            self.begin(lost, gravity)

    def _at(self, table: Array) -> Array:
        whole = np.minimum(self.time.astype(int), self._last[self.side])
        part = (self.time - whole)[..., None]
        return (1.0 - part) * table[self.side, whole] + part * table[self.side, whole + 1]

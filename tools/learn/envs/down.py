"""How episodes of getting up begin: lying, falling, or along a clip that gets up; more often where it fails."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.world import Start
from servoid.hw.robot.description import Robot
from servoid.policy.motion.library import Library
from servoid.policy.rising.lead import CLIPS
from servoid.tools.learn.envs.starts import States, along, falling, lying

KINDS = ("lying on the front", "lying on the back", "falling", "along a clip")
_DROPPED, _PUSHED, _ROLLED_OUT = 2, 8, 64  # one body for so many starts: that is dropped, pushed, or follows a clip
_FALLING = 0.3  # of those that do not begin lying: they begin while the robot falls
_LEARNED = 0.02  # of a kind's success, from one episode
_ALWAYS = 0.3  # weight of a side that never fails, beside 1 of one that always does


class Down:
    """Draws the states that episodes begin in, and learns on which side it is hard."""

    def __init__(self, robot: Robot, eased: tuple[float, float], starts: int, seed: int) -> None:
        """`eased`: the share that does not begin lying, at the start of a training and from half of it on.

        Drops, pushes and rolls out bodies first, for some `starts` states, which takes seconds. Without clips of the
        robot none begins along one. Raises ConfigError where no body comes to lie.
        """
        self.robot, self._eased = robot, eased
        dropped = lying(robot, max(starts // _DROPPED, 1), seed)
        if not len(dropped.joints):
            raise ConfigError(f"--starts {starts}: none of the bodies that were dropped lies still; give more")
        parts = [dropped.only(dropped.front), dropped.only(~dropped.front)]
        parts.append(falling(robot, max(starts // _PUSHED, 1), seed))
        try:
            library = Library(robot)
            clips = [library[name] for name in CLIPS]
        except ConfigError:
            clips = []
        if clips:
            parts.append(along(robot, clips, max(starts // _ROLLED_OUT, 1), seed))
        self._counts = np.array([len(part.joints) for part in parts])
        self.states = States.joined(parts)
        self._first = np.cumsum(self._counts) - self._counts
        self._chances = np.full(len(KINDS), 0.5)  # of failure
        self._kind = np.zeros(0, int)
        self.clip, self.time = np.zeros(0, int), np.zeros(0)  # that worlds were drawn along, -1: none; ticks into it
        self._progress = 0.0

    @property
    def measures(self) -> Mapping[str, float]:
        """Share of the last episodes that came to stand, by how they began."""
        return {f"success/{kind}": 1.0 - float(chance) for kind, chance in zip(KINDS, self._chances, strict=True)}

    def schedule(self, progress: float) -> None:
        """Draw as at `progress` of the training, 0 to 1."""
        self._progress = progress

    def learn(self, where: Array, achieved: Array) -> None:
        """Episodes are over in the worlds `where` `(n,)`, and the robot came to stand or not `(n,)`."""
        for i in np.flatnonzero(where).tolist():
            kind = self._kind[i]
            self._chances[kind] += _LEARNED * (float(not achieved[i]) - self._chances[kind])

    def draw(self, rngs: Sequence[np.random.Generator], where: Array) -> Start:
        """Starts of the worlds `where` `(n,)` bool; a row for each world."""
        if len(self._kind) != len(where):
            self._kind = np.zeros(len(where), int)
        eased = float(np.interp(self._progress, [0.0, 0.5], self._eased))
        hard = _ALWAYS + (1.0 - _ALWAYS) * self._chances[:2]
        shares = np.array([*(hard / hard.sum() * (1.0 - eased)), _FALLING * eased, (1.0 - _FALLING) * eased])
        shares = shares[: len(self._counts)] * (self._counts > 0)
        rows = np.zeros(len(where), int)
        for i in np.flatnonzero(where).tolist():
            kind = int(rngs[i].choice(len(shares), p=shares / shares.sum()))
            self._kind[i] = kind
            rows[i] = self._first[kind] + rngs[i].integers(self._counts[kind])
        picked = self.states.only(rows)
        self.clip, self.time = picked.clip, picked.time
        return Start(
            joints=np.clip(picked.joints, self.robot.lower, self.robot.upper),
            position=picked.position,
            orientation=picked.orientation,
            velocity=picked.velocity,
            angular_velocity=picked.angular_velocity,
            joint_velocity=picked.joint_velocity,
        )

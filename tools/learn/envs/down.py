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
_DROPPED, _PUSHED = 512, 128  # bodies whose states are kept
_ROLLOUTS = 16  # of each clip
_FALLING = 0.3  # of those that are eased: they begin while the robot falls
_LEARNED = 0.02  # of a kind's success, from one episode
_ALWAYS = 0.3  # weight of what never fails, beside 1 of what always does


class Down:
    """Draws the states that episodes begin in, and learns which of them are hard."""

    def __init__(self, robot: Robot, eased: tuple[float, float], seed: int) -> None:
        """`eased`: the share that does not begin lying, at the start of a training and from half of it on.

        Drops, pushes and rolls out bodies first, which takes seconds. A robot without clips begins lying alone."""
        self.robot, self._eased = robot, eased
        dropped = lying(robot, _DROPPED, seed)
        front = dropped.front
        parts = [dropped.only(front), dropped.only(~front), falling(robot, _PUSHED, seed)]
        try:
            library = Library(robot)
            clips = [library[name] for name in CLIPS]
        except ConfigError:
            clips = []
        if clips:
            parts.append(along(robot, clips, _ROLLOUTS, seed))
        self._parts = [part for part in parts if len(part.joints)]
        self.states = States.joined(self._parts)
        self._first = np.cumsum([0, *(len(part.joints) for part in self._parts)])
        self._chances = np.full(len(KINDS), 0.5)  # of failure
        self._kind = np.zeros(0, int)
        self.clip, self.time = np.zeros(0, int), np.zeros(0)  # that worlds were drawn along, -1: none; ticks into it
        self._progress = 0.0

    @property
    def measures(self) -> Mapping[str, float]:
        """Share of the last episodes that came to stand, by how they began."""
        return {f"success/{kind}": 1.0 - float(chance) for kind, chance in zip(KINDS, self._chances, strict=True)}

    def schedule(self, progress: float) -> None:
        self._progress = progress

    def learn(self, where: Array, succeeded: Array) -> None:
        """Episodes are over in the worlds `where` `(n,)`, and came to stand or not `(n,)`."""
        for i in np.flatnonzero(where).tolist():
            kind = self._kind[i]
            self._chances[kind] += _LEARNED * (float(not succeeded[i]) - self._chances[kind])

    def draw(self, rngs: Sequence[np.random.Generator], where: Array) -> Start:
        """Starts of the worlds `where` `(n,)` bool; a row for each world."""
        if len(self._kind) != len(where):
            self._kind = np.zeros(len(where), int)
        eased = float(np.interp(self._progress, [0.0, 0.5], self._eased))
        hard = _ALWAYS + (1.0 - _ALWAYS) * self._chances[:2]
        shares = np.array([*(hard / hard.sum() * (1.0 - eased)), _FALLING * eased, (1.0 - _FALLING) * eased])
        shares = np.cumsum(shares[: len(self._parts)])
        shares /= shares[-1]
        rows = np.zeros(len(where), int)
        for i in np.flatnonzero(where).tolist():
            kind = min(int(np.searchsorted(shares, rngs[i].random())), len(self._parts) - 1)
            self._kind[i] = kind
            rows[i] = rngs[i].integers(self._first[kind], self._first[kind + 1])
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

"""How fast the tracker's training asks its worlds to go: a curriculum that grows as what is asked is followed."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot, Walking
from servoid.policy.references.gait import Gait

_FAST = 0.85  # of the top speed: what is asked to go as fast is what the curriculum judges
_FOLLOWED = 0.8  # of what was asked, on the mean
_MEMORY = 100  # ticks over which it is judged, of all worlds together
_GROWTH = 1e-3  # a tick, of the top speed
_FORWARD, _TURNING = 0, 2


class Speeds:
    """Top speeds straight ahead and of turning on the spot, `walking`: at first the robot's own; those of the `gait` in
    the end, where one is given.

    Each grows for as long as worlds that are asked for nearly all of it go at 0.8 of what is asked; one that has
    fallen goes at nothing.
    """

    def __init__(self, robot: Robot, gait: Gait | None = None) -> None:
        self.walking: Walking = robot.walking
        self._end = None if gait is None else np.maximum(gait.upper, robot.walking.upper)
        self._followed = np.zeros(3)

    def learn(self, asked: Array, measured: Array, fallen: Array) -> None:
        """By a tick of worlds that walk: twists `(n, 3)` over the last cycle, and which have fallen in it `(n,)`."""
        if self._end is None:
            return
        top = self.walking.upper
        for axis in (_FORWARD, _TURNING):
            others = np.delete(np.abs(asked) / top, axis, -1).max(-1)
            fast = (np.abs(asked[:, axis]) > _FAST * top[axis]) & (others < 0.1)
            if not fast.any():
                continue
            share = np.where(fallen, 0.0, measured[:, axis] / np.where(fast, asked[:, axis], 1.0))[fast]
            # A fall is seen at one tick alone, and undoes as much as many ticks of walking do.
            weight = np.where(fallen[fast], _MEMORY / 4.0, 1.0)
            self._followed[axis] += (np.average(share, weights=weight) - self._followed[axis]) / _MEMORY
            if self._followed[axis] > _FOLLOWED:
                top[axis] = min(top[axis] * (1.0 + _GROWTH), self._end[axis])
        self.walking = replace(self.walking, forward=float(top[_FORWARD]), turning=float(top[_TURNING]))

    @property
    def measures(self) -> dict[str, float]:
        """For the training's log."""
        if self._end is None:
            return {}
        return {
            "top/forward": self.walking.forward,
            "top/turning": self.walking.turning,
            "followed/forward": float(self._followed[_FORWARD]),
            "followed/turning": float(self._followed[_TURNING]),
        }

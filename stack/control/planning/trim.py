"""Slow correction of a planner's commanded twist by the measured one.

Guidance pulls a plan toward the asked twist, and the motions that a model knows pull it back, so that a robot goes a
little faster or slower than it was told. An integrator on the difference, averaged over gait cycles, takes that out.
"""

from __future__ import annotations

from collections import deque

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import State
from servoid.hw.robot.description import Robot
from servoid.policy.references.gait import gait_of

# Of the shipped robot, m/s, m/s, rad/s; others have the same shares of their top speeds.
_JUMP = np.array([0.05, 0.05, 0.2])  # a larger change of what is asked begins anew
_LIMIT = np.array([0.08, 0.06, 0.3])  # of the correction


class Trim:
    """Call once a tick with the twist that is asked, `(..., 3)` m/s forward, m/s left, rad/s."""

    def __init__(self, robot: Robot, rate: float, shape: tuple[int, ...] = ()) -> None:
        """`rate` [1/s] is the share of the difference that is added a second; 0 turns the correction off."""
        self._step = rate * robot.dt
        self._jump, self._limit = robot.walking.relative * _JUMP, robot.walking.relative * _LIMIT
        self._cycle = round(gait_of(robot).cycle / robot.dt)  # ticks: within a cycle, every walk sways
        self._differences: deque[Array] = deque(maxlen=self._cycle)
        self._asked = np.zeros((*shape, 3))
        self._since = np.zeros(shape, int)  # ticks
        self._correction = np.zeros((*shape, 3))

    def reset(self, where: Array | None = None) -> None:
        """Begin anew in the worlds `where` (default: all)."""
        where = np.ones_like(self._since, bool) if where is None else where
        self._since = np.where(where, 0, self._since)
        self._correction = np.where(where[..., None], 0.0, self._correction)

    def __call__(self, state: State, asked: Array) -> Array:
        """The twist `(..., 3)` to ask for instead. Who is told to stand is told to stand."""
        asked = np.asarray(asked, dtype=float)
        measured = np.stack([state.velocity[..., 0], state.velocity[..., 1], state.angular_velocity[..., 2]], -1)
        begun = np.any(np.abs(asked - self._asked) > self._jump, axis=-1)
        self._differences.append(asked - measured)
        self._asked, self._since = asked, np.where(begun, 0, self._since + 1)
        step = np.where(self._since >= self._cycle, self._step, 0.0)[..., None]
        correction = self._correction + step * np.mean(self._differences, axis=0)
        correction = np.where(begun[..., None], 0.0, np.clip(correction, -self._limit, self._limit))
        moving = (asked != 0.0).any(-1, keepdims=True)
        self._correction = np.where(moving, correction, 0.0)
        return asked + self._correction

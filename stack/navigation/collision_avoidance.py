"""Which way to walk past other walking robots, for policies that follow a velocity."""

from __future__ import annotations

from collections import deque
from dataclasses import dataclass, field
from typing import Annotated

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.setting import Setting, check
from servoid.policy.references.gait import load_gait

_WAYS = np.linspace(-0.5 * np.pi, 0.5 * np.pi, 25)  # rad to the left of the goal


@dataclass(frozen=True)
class AvoidanceSettings:
    apart: Annotated[
        float, Setting("distance between the middles of two robots that pass", "m", above=0, of="height")
    ] = 0.42
    fade: Annotated[
        float, Setting("nearer than that which is as bad as a detour of 90 degrees", "m", above=0, of="height")
    ] = 0.04
    horizon: Annotated[float, Setting("how far ahead the robot looks", "s", above=0)] = 4.0
    # Two cycles of the gait, which sways.
    window: Annotated[float, Setting("time over which the others' velocity is measured", "s", above=0, of="cycle")] = (
        field(default_factory=lambda: 2 * load_gait().cycle)
    )
    # Two who meet head-on must not choose alike.
    right: Annotated[float, Setting("how much worse it is to pass on the left", least=0)] = 0.1
    steady: Annotated[float, Setting("how much worse it is to change the way by a radian", least=0)] = 0.1

    def __post_init__(self) -> None:
        check(self)


class MeanVelocity:
    """How fast others go, from where they were at each tick before."""

    def __init__(self, window: float, dt: float) -> None:
        self._places: deque[Array] = deque(maxlen=max(round(window / dt), 1) + 1)
        self._dt = dt

    def update(self, places: Array) -> Array:
        """Mean velocity `(n, 2)` m/s over the window of those who are at `places` `(n, 2)` m, once a tick."""
        self._places.append(places.copy())
        ticks = len(self._places) - 1
        result: Array = (places - self._places[0]) / (max(ticks, 1) * self._dt)
        return result


def bearing_past(goal: Array, others: Array, speed: float, before: float, passing: AvoidanceSettings) -> float:
    """Bearing [rad] to walk at, past `others` `(n, 4)`, x, y m and their velocity m/s, to `goal` `(2,)` m.

    All are in one frame with the robot at its origin, and so is `before`, the bearing that was chosen last. Of straight
    ways at `speed` [m/s] it takes the one of least `1 - cos a + r max(a, 0) + s |a - b| + sum((apart - d) / fade)`, a
    being its angle to the left of the goal, b that of `before`, and d the least distance from each other robot within
    the horizon, where it is less than `apart` and gets any less.
    """
    ahead = np.arctan2(goal[1], goal[0])
    bearings = ahead + _WAYS
    velocity = speed * np.stack([np.cos(bearings), np.sin(bearings)], axis=-1)
    relative = others[:, 2:] - velocity[:, None]  # (ways, n, 2)
    until = min(passing.horizon, float(np.hypot(*goal)) / speed)
    speeds = np.maximum((relative**2).sum(-1), 1e-9)
    nearest = np.clip(-(others[:, :2] * relative).sum(-1) / speeds, 0.0, until)
    distance = np.linalg.norm(others[:, :2] + nearest[..., None] * relative, axis=-1)
    close = np.maximum(passing.apart - distance, 0.0).sum(-1) / passing.fade
    turn = np.abs(np.angle(np.exp(1j * (bearings - before))))
    cost = 1.0 - np.cos(_WAYS) + passing.right * np.maximum(_WAYS, 0.0) + passing.steady * turn + close
    return float(bearings[np.argmin(cost)])

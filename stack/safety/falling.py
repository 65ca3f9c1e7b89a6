"""Whether a fall can still be avoided, and whether a robot that is not tilted still stands on its feet."""

from __future__ import annotations

import math

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import State
from servoid.hw.robot.legs import Legs

# A falling robot is a pendulum on its foot: where its tilt will be in `AHEAD` at the present rate tells a fall before
# the tilt itself does. Of 96 robots drawn at random that walked and were pushed by 0.1 to 0.8 m/s each 2 s, none that
# stayed up came to more than 0.70 rad by this measure; the 55 that fell passed `LOST` 0.12 s, in the median, before
# they were tilted by 1.05 rad.
AHEAD = 0.125  # s
LOST = 0.9  # rad
CERTAIN_TICKS = 2  # in a row
OFF_FLAT = 0.8  # rad between both soles and the ground: it sits, kneels or lies, however upright its base is
OFF_SECONDS = 1.0


def tipping(state: State) -> Array:
    """Tilt `(...)` rad that the base will have in `AHEAD`, at the rate at which it grows now."""
    down = state.gravity
    tilt = np.arccos(np.clip(-down[..., 2], -1.0, 1.0))
    # Gravity is fixed in the world, so that in the base frame it turns against the base: g' = -w x g.
    rising = -(state.angular_velocity[..., 0] * down[..., 1] - state.angular_velocity[..., 1] * down[..., 0])
    across = np.sqrt(np.maximum(1.0 - down[..., 2] ** 2, 0.0))
    turning = np.hypot(state.angular_velocity[..., 0], state.angular_velocity[..., 1])
    return tilt + AHEAD * np.where(across > 0.05, rising / np.maximum(across, 0.05), turning)


class Falling:
    """Watches a robot that runs. What it says is final: from then on it falls."""

    def __init__(self, legs: Legs, rate: float) -> None:
        self._legs, self._rate = legs, rate
        self._lost = self._off = 0  # ticks in a row

    def watch(self, state: State, passed: int) -> str | None:
        """Why the robot counts as falling or lying, `passed` ticks after the last look; None where it does not."""
        ahead = float(tipping(state))
        self._lost = self._lost + passed if ahead > LOST else 0
        _, rotation, _, _ = self._legs.forward(self._legs.pick(state.position))
        flat = rotation[..., 2] @ -state.gravity
        self._off = self._off + passed if bool((flat < math.cos(OFF_FLAT)).all()) else 0
        if self._lost >= CERTAIN_TICKS:
            return f"tipping over: {math.degrees(ahead):.0f} degrees ahead"
        if self._off >= OFF_SECONDS * self._rate:
            return "neither sole is on the ground: it sits, kneels or lies"
        return None

    def reset(self) -> None:
        self._lost = self._off = 0

"""The speed profile toward a point: turn to it, walk ahead, and take small steps in any direction when it is near."""

from __future__ import annotations

import math
from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.body import Array


@dataclass(frozen=True)
class Approach:
    speed: float = 0.25  # m/s forward, far from the goal
    creep: float = 0.12  # m/s that a walking robot keeps to until it stops: slower steps hardly move it
    reverse: float = 0.08  # m/s backward at most, near the goal
    lateral: float = 0.08  # m/s to either side at most, near the goal
    yaw_rate: float = 0.8  # rad/s at most
    turn_gain: float = 1.5  # rad/s per rad of bearing
    turn_first: float = 1.0  # rad of bearing from which the robot turns on the spot
    brake: float = 0.4  # m from the goal at which to slow down
    near: float = 0.0  # m from the goal within which steps go in any direction

    def __post_init__(self) -> None:
        for key in ("speed", "creep", "yaw_rate", "turn_gain", "turn_first", "brake"):
            if getattr(self, key) <= 0.0:
                raise ValueError(f"{key}: must be positive")
        for key in ("reverse", "lateral", "near"):
            if getattr(self, key) < 0.0:
                raise ValueError(f"{key}: must not be negative")
        if self.creep > self.speed:
            raise ValueError(f"creep: {self.creep:g} m/s is faster than speed ({self.speed:g} m/s)")


def approach(goal: Array, profile: Approach) -> Array:
    """Velocity command `(3,)` m/s forward, m/s left, rad/s toward `goal` `(2,)` m, both in the heading frame."""
    distance, bearing = math.hypot(goal[0], goal[1]), math.atan2(goal[1], goal[0])
    speed = max(profile.speed * min(distance / profile.brake, 1.0), profile.creep)
    turn = min(max(profile.turn_gain * bearing, -profile.yaw_rate), profile.yaw_rate)
    if distance > profile.near:
        edge = math.cos(profile.turn_first)
        ahead = max((math.cos(bearing) - edge) / (1.0 - edge), 0.0)
        return np.array([speed * ahead, 0.0, turn])
    forward = max(speed * math.cos(bearing), -profile.reverse)
    left = min(max(speed * math.sin(bearing), -profile.lateral), profile.lateral)
    # The bearing of a goal underfoot swings wildly, and turning round for a few centimetres takes longer than a
    # step back: turn less the nearer the goal, and not at all for one behind.
    turn *= distance / profile.near if abs(bearing) < 0.5 * math.pi else 0.0
    return np.array([forward, left, turn])

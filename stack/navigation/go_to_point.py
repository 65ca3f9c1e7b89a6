"""The velocity that goes to a point: turn to it, walk ahead, and take small steps in any direction when it is near."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.setting import Setting, check


@dataclass(frozen=True)
class SpeedProfile:
    speed: Annotated[float, Setting("forward speed far from the goal", "m/s", above=0, asks="forward")] = 0.25
    creep: Annotated[
        float, Setting("slowest walk before the stop: slower steps hardly move it", "m/s", above=0, asks="forward")
    ] = 0.12
    reverse: Annotated[float, Setting("fastest step backward, near the goal", "m/s", least=0, asks="backward")] = 0.08
    lateral: Annotated[float, Setting("fastest step to either side, near the goal", "m/s", least=0, asks="left")] = 0.08
    yaw_rate: Annotated[float, Setting("fastest turn", "rad/s", above=0, asks="turning")] = 0.8
    turn_gain: Annotated[float, Setting("turning rate for each rad of bearing", "1/s", above=0)] = 1.5
    turn_first: Annotated[float, Setting("bearing from which the robot turns on the spot", "rad", above=0)] = 1.0
    brake: Annotated[float, Setting("distance from the goal at which to slow down", "m", above=0)] = 0.4
    near: Annotated[float, Setting("distance within which steps go in any direction", "m", least=0)] = 0.0

    def __post_init__(self) -> None:
        check(self)
        if self.creep > self.speed:
            raise ValueError(f"creep: {self.creep:g} m/s is faster than speed ({self.speed:g} m/s)")


def go_to_point(goal: Array, profile: SpeedProfile) -> Array:
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

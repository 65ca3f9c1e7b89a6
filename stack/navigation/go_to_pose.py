"""The velocity that goes to a place and faces a given way there."""

from __future__ import annotations

import math

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.stack.navigation.go_to_point import SpeedProfile, go_to_point

NEAR = 0.15  # m from where it turns to face as asked, and only steps
GAIN = 1.5  # 1/s, of steps
LEAST = 0.09  # m/s: slower steps hardly move it
ALONG = 0.3  # rad off the way it shall face, up to where it steps while it turns


def go_to_pose(ahead: Array, turn: float, profile: SpeedProfile, within: float, near: float = NEAR) -> Array:
    """Velocity command `(3,)` m/s forward, m/s left, rad/s toward a place `ahead` `(2,)` m in the heading frame, to be
    within so many m of, and there to a heading that is `turn` rad to the left of the present one; from `near` m on it
    turns to that."""
    distance = math.hypot(ahead[0], ahead[1])
    if distance > near:
        return go_to_point(ahead, profile)
    rate = min(max(profile.turn_gain * turn, -profile.yaw_rate), profile.yaw_rate)
    if abs(turn) > ALONG:
        return np.array([0.0, 0.0, rate])
    forward, left = GAIN * ahead[0], GAIN * ahead[1]
    speed = math.hypot(forward, left)
    if within < distance and speed < LEAST:
        forward, left = forward * LEAST / speed, left * LEAST / speed
    top = np.array([profile.creep if forward > 0.0 else profile.reverse, profile.lateral])
    share = min(1.0, *(top / np.maximum(np.abs([forward, left]), 1e-9)))
    return np.array([share * forward, share * left, rate])

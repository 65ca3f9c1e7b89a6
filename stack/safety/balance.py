"""What hips and ankles do about a base that tilts or turns, beside what a motion asks of them."""

from __future__ import annotations

from dataclasses import astuple, dataclass

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import up_vector
from servoid.hw.robot.description import Robot
from servoid.hw.robot.legs import Legs

Gains = tuple[float, float]  # rad for each rad/s that the base turns [s], and for each rad that it tilts from standing


@dataclass(frozen=True)
class Balance:
    """Gains of joints about the base's axes; a foot's own goes the way that turns its toes, or its inner edge, down."""

    ankle_pitch: Gains = (0.0, 0.0)
    ankle_roll: Gains = (0.0, 0.0)
    hip_pitch: Gains = (0.0, 0.0)
    hip_roll: Gains = (0.0, 0.0)

    @property
    def gains(self) -> Array:
        """As `Feedback` takes them, `(4, 2)`."""
        return np.array(astuple(self), dtype=float)


class Feedback:
    """Adds to joint targets by gains `(..., 4, 2)` of `Balance`; of one robot, or of worlds of any leading shape."""

    def __init__(self, robot: Robot) -> None:
        legs = Legs(robot)
        self._joints, self._signs = zip(
            *(legs.turning(robot.home, axis, ankle=ankle) for ankle in (True, False) for axis in (1, 0)), strict=True
        )
        self._upright = -up_vector(legs.stand(robot.home)[1])

    def __call__(self, target: Array, gravity: Array, rate: Array, gains: Array) -> Array:
        """`target` `(..., n_joints)` rad, corrected by gravity's direction and what the gyro says `(..., 3)` rad/s."""
        out = target.copy()
        tilt = gravity - self._upright  # small: its x is a pitch forward, its y a roll to the right
        for i, (joints, signs) in enumerate(zip(self._joints, self._signs, strict=True)):
            pitch = i % 2 == 0
            lean = tilt[..., 0] if pitch else -tilt[..., 1]
            answer = gains[..., i, 0] * rate[..., 1 if pitch else 0] + gains[..., i, 1] * lean
            out[..., joints] += signs * answer[..., None]
        return out

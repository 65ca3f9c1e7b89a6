"""How an IMU is mounted: its axes against the base's, as the robot's file says."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.imu.rotations import IDENTITY, Quaternion, conjugate, multiply, yaw_pitch_roll

# A half turn about each axis is what negating the other two amounts to.
_HALF_TURNS: dict[tuple[float, float, float], Quaternion] = {
    (1.0, 1.0, 1.0): IDENTITY,
    (1.0, -1.0, -1.0): (0.0, 1.0, 0.0, 0.0),
    (-1.0, 1.0, -1.0): (0.0, 0.0, 1.0, 0.0),
    (-1.0, -1.0, 1.0): (0.0, 0.0, 0.0, 1.0),
}


class Mounting:
    """base = turn(roll, pitch, yaw) * signs * sensor.

    `signs` first put right what a sensor's registers negate; `angles` [rad] then turn its axes into the base's: about x
    by roll, about the base's y by pitch, about the base's z by yaw.
    """

    def __init__(
        self, signs: tuple[float, float, float] = (1.0, 1.0, 1.0), angles: tuple[float, float, float] = (0.0, 0.0, 0.0)
    ) -> None:
        roll, pitch, yaw = angles
        turn = yaw_pitch_roll(yaw, pitch, roll)
        self._matrix = _matrix(turn) * np.asarray(signs, dtype=float)
        half = _HALF_TURNS.get((float(signs[0]), float(signs[1]), float(signs[2])))
        self._back = None if half is None else conjugate(multiply(turn, half))

    def to_base(self, vector: Array) -> Array:
        """`(3,)` in the sensor's axes, in the base frame."""
        return self._matrix @ vector

    def to_sensor(self, vector: Array) -> Array:
        """`(3,)` in the base frame, in the sensor's axes."""
        return self._matrix.T @ vector

    def orientation(self, sensor: Quaternion | None) -> Array:
        """Orientation of the base `(4,)` from that of the sensor; NaN where there is none, or signs mirror the axes."""
        if sensor is None or self._back is None:
            return np.full(4, np.nan)
        return np.array(multiply(sensor, self._back))


def _matrix(q: Quaternion) -> Array:
    w, x, y, z = q
    return np.array(
        [
            [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
            [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
            [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
        ]
    )

"""The IMU of the OpenCR board: raw registers to the base frame, and whether they are alive."""

from __future__ import annotations

import numpy as np

from hw.dynamixel.tables import ControlTable
from hw.hal import Array

FROZEN = 3  # equal samples in a row that a living sensor, which has noise, does not give


class BoardImu:
    """Decodes the board's block from `button` to `yaw`. A sample that is dead or frozen is NaN.

    The board's fusion of angles is coarse (degrees) and its axes are not documented: orientation stays NaN, and the
    estimator does its own.
    """

    def __init__(self, table: ControlTable, signs: Array) -> None:
        """`signs` `(3,)` of the board's axes against the base's."""
        first, last = table.item("button"), table.item("yaw")
        self.address, self.length = first.address, last.end - first.address
        self._signs = np.asarray(signs, dtype=float)
        self._gyro = table.item("gyro_x")
        self._acceleration = table.item("acceleration_x")
        self._voltage = table.item("present_input_voltage")
        self._last = b""
        self._same = 0
        self.buttons = 0
        self.voltage = float("nan")  # V
        self.angular_velocity: Array = np.full(3, np.nan)  # rad/s
        self.specific_force: Array = np.full(3, np.nan)  # m/s2

    def update(self, data: bytes | None) -> bool:
        """Take a block, or None where none came; whether there is a valid sample now."""
        self.angular_velocity = np.full(3, np.nan)
        self.specific_force = np.full(3, np.nan)
        if data is None:
            return False
        self.buttons = data[0]
        self.voltage = data[self._voltage.address - self.address] * self._voltage.scale
        at = self._gyro.address - self.address
        block = data[at : at + 12]
        self._same = self._same + 1 if block == self._last else 0
        self._last = block
        raw = np.frombuffer(block, dtype="<i2")
        if not raw[3:].any() or self._same >= FROZEN:
            return False  # nothing weighs nothing: its chip does not answer
        self.angular_velocity = self._signs * raw[:3] * self._gyro.scale
        self.specific_force = self._signs * raw[3:] * self._acceleration.scale
        return True

"""The OpenCR board's block of registers from its buttons to its IMU: raw to the base frame, and whether it lives."""

from __future__ import annotations

import numpy as np

from servoid.hw.dynamixel.protocol.tables import ControlTable
from servoid.hw.faults import IMU_DEAD, IMU_FROZEN, IMU_SILENT
from servoid.hw.imu.mounting import Mounting
from servoid.hw.imu.reading import Reading

FROZEN = 3  # equal samples in a row that a living sensor, which has noise, does not give
BUTTONS = {"mode": 1, "start": 2, "user": 4}  # bits of the button register


class BoardImu:
    """Decodes the block. A sample that is dead or frozen is NaN, and its reading says which.

    The board's fusion of angles is coarse (degrees) and its axes are not documented: orientation stays NaN, and the
    estimator does its own.
    """

    def __init__(self, table: ControlTable, mounting: Mounting) -> None:
        first, last = table.item("button"), table.item("yaw")
        self.address, self.length = first.address, last.end - first.address
        self._mounting = mounting
        self._gyro = table.item("gyro_x")
        self._acceleration = table.item("acceleration_x")
        self._voltage = table.item("present_input_voltage")
        self._last = b""
        self._same = 0
        self._time_ns: int | None = None
        self.buttons = 0
        self.voltage = float("nan")  # V

    def update(self, data: bytes | None, time_ns: int | None) -> Reading:
        """Take a block that was sampled at `time_ns`, or None where none came. The reading's time is that of the newest
        valid sample."""
        if data is None:
            return Reading(self._time_ns, IMU_SILENT)
        self.buttons = data[0]
        self.voltage = data[self._voltage.address - self.address] * self._voltage.scale
        at = self._gyro.address - self.address
        block = data[at : at + 12]
        self._same = self._same + 1 if block == self._last else 0
        self._last = block
        raw = np.frombuffer(block, dtype="<i2")
        if not raw[3:].any():
            return Reading(self._time_ns, IMU_DEAD)  # nothing weighs nothing: its chip does not answer
        if self._same >= FROZEN:
            return Reading(self._time_ns, IMU_FROZEN)
        self._time_ns = time_ns
        return Reading(
            time_ns,
            0,
            self._mounting.to_base(raw[:3] * self._gyro.scale),
            self._mounting.to_base(raw[3:] * self._acceleration.scale),
        )

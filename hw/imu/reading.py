"""What an IMU gives: a sample in its own frame, and a reading in the robot's."""

from __future__ import annotations

from dataclasses import dataclass, field
from typing import Protocol

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.imu.rotations import Quaternion, Vector

GRAVITY = 9.80665  # m/s2 of the unit g of data sheets
UNKNOWN: Vector = (float("nan"), float("nan"), float("nan"))


@dataclass(frozen=True, slots=True)
class Sample:
    """One sample in the sensor's frame. What a sensor does not measure is NaN, or None for the orientation."""

    number: int  # counts samples; two of the same number differ in orientation only
    raw: bytes  # as measured: a living sensor has noise, and does not repeat itself
    angular_velocity: Vector  # rad/s
    specific_force: Vector  # m/s2
    orientation: Quaternion | None  # sensor to a world whose z is up


def _nothing() -> Array:
    return np.full(3, np.nan)


@dataclass(frozen=True, slots=True)
class Reading:
    """The newest that is known, in the base frame. Not valid is NaN; `fault` says why, as bits of servoid.hw.faults."""

    time_ns: int | None = None  # when that was sampled; None: never
    fault: int = 0
    angular_velocity: Array = field(default_factory=_nothing)  # (3,) rad/s
    specific_force: Array = field(default_factory=_nothing)  # (3,) m/s2
    orientation: Array = field(default_factory=lambda: np.full(4, np.nan))  # (4,) w x y z


class Decoder(Protocol):
    """Turns the bytes of a kind of sensor into samples. It never raises, whatever the bytes, and keeps few of them."""

    frame_bytes: int  # that a sample takes on the wire
    garbage: int  # bytes that belonged to no frame
    bad: int  # frames whose checksum or content was wrong

    def feed(self, data: bytes) -> list[Sample]:
        """Samples that are complete with `data`, oldest first."""
        ...

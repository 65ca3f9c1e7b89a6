"""WitMotion sensors (WT901 and their like): frames of 11 bytes, several to a sample.

    55 TYPE D0L D0H D1L D1H D2L D2H D3L D3H SUM        SUM: of the ten bytes before, modulo 256

Source: WitMotion's standard protocol. A sample goes out as acceleration (51), angular velocity (52) and, where the
sensor is told to send them, angles (53) or a quaternion (59). Sensors leave the factory at 9600 bit/s and 10 samples a
second, too slow for a loop: set them to 115200 and 100 or more.
"""

from __future__ import annotations

import math
import struct
from dataclasses import replace

from servoid.hw.imu.frames import Scan, scan
from servoid.hw.imu.reading import GRAVITY, Sample
from servoid.hw.imu.rotations import Quaternion, yaw_pitch_roll

HEAD = b"\x55"
SIZE = 11
ACCELERATION, ANGULAR_VELOCITY, ANGLES, QUATERNION = 0x51, 0x52, 0x53, 0x59
TYPES = range(0x50, 0x60)  # all that the protocol has, this driver's and others
_FORCE = 16.0 * GRAVITY / 32768.0  # m/s2 a count
_RATE = math.radians(2000.0) / 32768.0  # rad/s a count
_ANGLE = math.pi / 32768.0  # rad a count
_UNIT = 1.0 / 32768.0
_NORM = 0.05  # that a unit quaternion of 16 bits may be off
_DATA = struct.Struct("<4h")


def frames(data: bytes) -> Scan:
    """Frames of any type in `data`. Pure; never raises."""
    return scan(data, HEAD, SIZE, _good)


def _good(frame: bytes) -> bool:
    return frame[1] in TYPES and sum(frame[:-1]) & 0xFF == frame[-1]


class WitMotion:
    """A decoder. A sample is there with its angular velocity, and once more with its orientation when that follows;
    until then it has the orientation of the sample before. An acceleration without its angular velocity is dropped."""

    frame_bytes = 3 * SIZE

    def __init__(self) -> None:
        self.garbage = self.bad = 0
        self._rest = b""
        self._force: bytes | None = None
        self._orientation: Quaternion | None = None
        self._has_quaternion = False
        self._last: Sample | None = None
        self._number = 0

    def feed(self, data: bytes) -> list[Sample]:
        found = frames(self._rest + data)
        self._rest = found.rest
        self.garbage += found.garbage
        self.bad += found.bad
        samples = []
        for frame in found.frames:
            sample = self._take(frame[1], frame[2:-1])
            if sample is not None:
                samples.append(sample)
        return samples

    def _take(self, kind: int, data: bytes) -> Sample | None:
        if kind == ACCELERATION:
            self._force, self._last = data[:6], None
        elif kind == ANGULAR_VELOCITY and self._force is not None:
            raw, self._force = self._force + data[:6], None
            fx, fy, fz, wx, wy, wz = struct.unpack("<6h", raw)
            self._number += 1
            self._last = Sample(
                number=self._number,
                raw=raw,
                angular_velocity=(wx * _RATE, wy * _RATE, wz * _RATE),
                specific_force=(fx * _FORCE, fy * _FORCE, fz * _FORCE),
                orientation=self._orientation,
            )
            return self._last
        elif kind == QUATERNION or (kind == ANGLES and not self._has_quaternion):
            orientation = self._turn(kind, data)
            if orientation is None:
                return None
            self._orientation = orientation
            if self._last is not None:
                self._last = replace(self._last, orientation=orientation)
                return self._last
        return None

    def _turn(self, kind: int, data: bytes) -> Quaternion | None:
        a, b, c, d = _DATA.unpack(data)
        if kind == ANGLES:
            return yaw_pitch_roll(c * _ANGLE, b * _ANGLE, a * _ANGLE)
        w, x, y, z = a * _UNIT, b * _UNIT, c * _UNIT, d * _UNIT
        norm = math.sqrt(w * w + x * x + y * y + z * z)
        if abs(norm - 1.0) > _NORM:
            self.bad += 1
            return None
        self._has_quaternion = True
        return w / norm, x / norm, y / norm, z / norm

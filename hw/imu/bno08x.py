"""BNO080, BNO085 and BNO086 in their UART-RVC mode: 19 bytes, 100 times a second at 115200 bit/s.

    AA AA INDEX YAW PITCH ROLL AX AY AZ 0 0 0 SUM      16 bits each, low byte first; SUM: of INDEX to 0, modulo 256

Source: BNO080 data sheet, 1.3.5.2. Angles count 0.01 degrees, accelerations 0.001 g. The rotations are applied in the
order yaw, pitch, roll. The data sheet's words put pitch about y and roll about x, but its own example message has it
the other way: only with pitch about x and roll about y do its angles agree with its accelerations (to 0.1 degree), and
so they are taken here. Which way yaw counts it does not say, and nothing in a message can tell: `yaw_sign` is 1 for
counterclockwise seen from above. Turn the robot left by hand: its angular velocity about z must be positive.

The mode has no gyro. The angular velocity given here is derived: the turn between the orientations of now and of two
messages before, divided by the time that their indices say has passed. It is a mean over 20 ms, so 10 ms late, and
angles of 0.01 degrees make it coarse (0.009 rad/s). Where messages are missing it is NaN.
"""

from __future__ import annotations

import math
import struct

from servoid.hw.imu.frames import Scan, scan
from servoid.hw.imu.reading import GRAVITY, UNKNOWN, Sample
from servoid.hw.imu.rotations import Quaternion, Vector, about, multiply, turn_between

HEAD = b"\xaa\xaa"
SIZE = 19
PERIOD = 0.01  # s
SPAN = 2  # messages that the angular velocity is a mean over
_ANGLE = math.radians(0.01)
_FORCE = 0.001 * GRAVITY
_DATA = struct.Struct("<2xB6h")


def frames(data: bytes) -> Scan:
    """Messages in `data`. Pure; never raises."""
    return scan(data, HEAD, SIZE, _good)


def _good(frame: bytes) -> bool:
    return sum(frame[2:-1]) & 0xFF == frame[-1]


class Bno08x:
    """A decoder: one sample a message."""

    frame_bytes = SIZE

    def __init__(self, yaw_sign: float = 1.0) -> None:
        self.garbage = self.bad = 0
        self._yaw = yaw_sign
        self._rest = b""
        self._number = 0
        self._index: int | None = None
        self._past: list[Quaternion] = []  # of messages without a gap, oldest first

    def feed(self, data: bytes) -> list[Sample]:
        found = frames(self._rest + data)
        self._rest = found.rest
        self.garbage += found.garbage
        self.bad += found.bad
        return [sample for frame in found.frames if (sample := self._take(frame)) is not None]

    def _take(self, frame: bytes) -> Sample | None:
        index, yaw, pitch, roll, ax, ay, az = _DATA.unpack_from(frame)
        if index == self._index:
            return None  # the same once more
        follows = self._index is not None and (index - self._index) % 256 == 1
        self._index = index
        orientation = multiply(
            multiply(about(2, self._yaw * yaw * _ANGLE), about(0, pitch * _ANGLE)), about(1, roll * _ANGLE)
        )
        self._past = [*self._past[-SPAN:], orientation] if follows else [orientation]
        self._number += 1
        return Sample(
            number=self._number,
            raw=frame[3:15],
            angular_velocity=self._rate(),
            specific_force=(ax * _FORCE, ay * _FORCE, az * _FORCE),
            orientation=orientation,
        )

    def _rate(self) -> Vector:
        if len(self._past) <= SPAN:
            return UNKNOWN
        x, y, z = turn_between(self._past[0], self._past[-1])
        seconds = SPAN * PERIOD
        return x / seconds, y / seconds, z / seconds

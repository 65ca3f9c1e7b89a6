"""What sensors send, written down from their data sheets independently of the decoders."""

from __future__ import annotations

import struct


def wit(kind: int, *values: int) -> bytes:
    """A WitMotion frame of four 16-bit values."""
    body = b"\x55" + bytes([kind]) + struct.pack("<4h", *values)
    return body + bytes([sum(body) % 256])


def wit_sample(
    force: tuple[int, int, int] = (0, 0, 2048), rate: tuple[int, int, int] = (0, 0, 0), *, angles: bool = True
) -> bytes:
    """Acceleration (2048 counts are 1 g), angular velocity, and level angles."""
    return wit(0x51, *force, 2500) + wit(0x52, *rate, 0) + (wit(0x53, 0, 0, 0, 0) if angles else b"")


def rvc(index: int, yaw: int = 0, pitch: int = 0, roll: int = 0, force: tuple[int, int, int] = (0, 0, 1000)) -> bytes:
    """A BNO08x message: hundredths of a degree and thousandths of g."""
    body = struct.pack("<B6h3x", index % 256, yaw, pitch, roll, *force)
    return b"\xaa\xaa" + body + bytes([sum(body) % 256])

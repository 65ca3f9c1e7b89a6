"""Everything that reads bytes from outside, as targets of `servoid bench fuzz`.

A target takes one stream after the other and keeps what it keeps between them, as on a real line. It raises Unbounded
where it holds or makes more than the stream can be worth.
"""

from __future__ import annotations

import math
from collections.abc import Sequence
from typing import Protocol

import numpy as np

from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.codec import MAX_LENGTH, PacketParser
from servoid.hw.dynamixel.transport.bus import Bus
from servoid.hw.dynamixel.transport.group_read import GroupRead
from servoid.hw.imu.bno08x import Bno08x
from servoid.hw.imu.reading import Decoder
from servoid.hw.imu.witmotion import WitMotion
from servoid.hw.robot.description import Robot
from servoid.sim.rig.rig import Rig
from servoid.sim.rig.servo.motor_bank import STEP_NS
from servoid.tools.faults.streams import BOARD_ID, IDS, WIDTH

_ANSWER_BYTES = 100_000  # more than the servos of a robot send in half a second at 1 Mbit/s
_STREAMS_A_STEP = 20  # that the servos hear in a step of physics
_BOOT_NS = 400_000_000
_BUS_EVERY = 8  # streams of which the driver's bus hears one: it takes longest


class Unbounded(Exception):
    """A target holds or makes more than a stream can be worth."""


class Target(Protocol):
    """Something that reads bytes."""

    name: str

    def take(self, pieces: Sequence[bytes]) -> None: ...


class CodecTarget:
    """The parser of packets, and the ways through whole answers."""

    name = "codec"

    def __init__(self) -> None:
        self._parser = PacketParser()
        self._heads = [codec.status_head(id, WIDTH) for id in IDS]
        self._fast_head = codec.fast_head([WIDTH] * len(IDS))

    def take(self, pieces: Sequence[bytes]) -> None:
        for piece in pieces:
            for packet in self._parser.feed(piece):
                codec.as_status(packet)
            if self._parser.pending > MAX_LENGTH + 7 + len(piece):
                raise Unbounded(f"the parser holds {self._parser.pending} bytes")
        data = b"".join(pieces)
        codec.parse_fast(data, IDS, [WIDTH] * len(IDS))
        codec.whole_fast(data, self._fast_head, bytes(IDS), WIDTH)
        codec.whole_sync(data, self._heads, WIDTH)


class ImuTarget:
    """The parsers of IMUs on a serial port of their own."""

    name = "imu"

    def __init__(self) -> None:
        self._decoders: tuple[Decoder, ...] = (WitMotion(), Bno08x())

    def take(self, pieces: Sequence[bytes]) -> None:
        for decoder in self._decoders:
            for piece in pieces:
                samples = decoder.feed(piece)
                if len(samples) > 4 + len(piece) // 11:
                    raise Unbounded(f"{len(samples)} samples from {len(piece)} bytes")
                for sample in samples:
                    if any(map(math.isinf, (*sample.angular_velocity, *sample.specific_force))):
                        raise ValueError(f"a sample that is infinite: {sample}")


class ServoTarget:
    """The virtual servos and the board, moved by physics."""

    name = "servos"

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._rig = Rig(robot)
        self._heard = 0
        self.renew()

    def renew(self) -> None:
        """A rig as delivered, with power."""
        rig = self._rig
        rig.reset(0)
        rig.wire.host_baud = self._robot.bus.baud
        self._heard = 0
        rig.host_sends(codec.write(BOARD_ID, 24, b"\1"))
        rig.advance(rig.now_ns + _BOOT_NS)

    def take(self, pieces: Sequence[bytes]) -> None:
        rig = self._rig
        for piece in pieces:
            rig.dispatcher.receive(piece, rig.wire.host_baud, rig.now_ns)
        answered = sum(len(sent.data) for _, _, sent in rig.wire._replies)
        if answered > _ANSWER_BYTES * len(pieces):
            raise Unbounded(f"{answered} bytes of answers to {sum(map(len, pieces))}")
        rig.wire.clear()
        self._heard += 1
        if self._heard % _STREAMS_A_STEP == 0:
            rig.advance(rig.now_ns + STEP_NS)
            rig.accepted.clear()
            if not np.isfinite(rig.plant.data.qpos).all():
                raise ValueError("the body is no longer anywhere")


class DriverTarget:
    """The driver's bus, whose servos answer with the stream."""

    name = "bus"

    def __init__(self) -> None:
        self._line = _Line()
        self._bus = Bus(self._line, self._line)
        self._groups = [GroupRead([(id, 126, WIDTH) for id in IDS], fast=fast) for fast in (True, False)]
        self._count = 0

    def take(self, pieces: Sequence[bytes]) -> None:
        self._count += 1
        if self._count % _BUS_EVERY:
            return
        began = self._line.time
        for group in self._groups:
            self._line.answer(pieces)
            self._bus.sync_read(group)
        self._line.answer(pieces)
        self._bus.ping(1, tries=1)
        if self._line.time - began > 200_000_000:
            raise Unbounded(f"three exchanges took {(self._line.time - began) * 1e-9:.3f} s of the bus's time")


class _Line:
    """A port and a clock: silent until something is asked, then every look finds the next piece of the answer."""

    name = "fuzz"
    baud = 2_000_000

    def __init__(self) -> None:
        self.time = 0
        self._pieces: list[bytes] = []
        self._asked = False

    def answer(self, pieces: Sequence[bytes]) -> None:
        """What comes after the next write. Before it, the bus would drop it as stray."""
        self._pieces, self._asked = list(pieces), False

    def now_ns(self) -> int:
        return self.time

    def sleep_until(self, time_ns: int) -> None:
        self.time = max(self.time, time_ns)

    def set_baud(self, baud: int) -> None: ...

    def write(self, data: bytes) -> None:
        self._asked = True

    def read(self) -> bytes:
        return self._pieces.pop(0) if self._asked and self._pieces else b""

    def close(self) -> None: ...

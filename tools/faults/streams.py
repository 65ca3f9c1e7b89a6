"""Byte streams that upset parsers: noise, true packets, and true packets that were damaged, cut and run together."""

from __future__ import annotations

import random
import struct
from collections.abc import Callable
from itertools import pairwise

from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.codec import InstructionCode, Reset
from servoid.hw.imu import bno08x, witmotion

IDS = tuple(range(1, 21))
BOARD_ID = 200
WIDTH = 10  # bytes of each servo in the reads of a control cycle
_LONG = 0.01  # share of packets longer than a parser waits for
_RARE = (InstructionCode.REBOOT, InstructionCode.FACTORY_RESET)  # after which devices are silent for long
_COMMON = tuple(instruction for instruction in InstructionCode if instruction not in _RARE)


def stream(seed: int, number: int) -> list[bytes]:
    """Stream `number` of a seed, in the pieces that it comes in."""
    r = random.Random((seed << 40) + number)
    make = r.choice(_FAMILIES)
    data = b"".join(make(r) for _ in range(r.randint(1, 4)))
    if r.random() < 0.6:
        data = mutate(r, data)
    cuts = sorted(r.randrange(len(data) + 1) for _ in range(r.randint(0, 3)))
    ends = [0, *cuts, len(data)]
    return [data[a:b] for a, b in pairwise(ends)]


def mutate(r: random.Random, data: bytes) -> bytes:
    """Flip, drop, double, insert or cut, once or a few times."""
    damaged = bytearray(data)
    for _ in range(r.randint(1, 3)):
        at = r.randrange(len(damaged) + 1)
        kind = r.randrange(6)
        if kind == 0 and at < len(damaged):
            damaged[at] ^= 1 << r.randrange(8)
        elif kind == 1 and at < len(damaged):
            damaged[at] = r.choice((0x00, 0xFD, 0xFE, 0xFF, 0x55, 0xAA))
        elif kind == 2:
            del damaged[at : at + r.randint(1, 8)]
        elif kind == 3:
            damaged[at:at] = damaged[at : at + r.randint(1, 30)]
        elif kind == 4:
            damaged[at:at] = r.choice((codec.HEADER, codec.STUFFED, witmotion.HEAD, bno08x.HEAD, r.randbytes(5)))
        else:
            del damaged[at:]
    return bytes(damaged)


def _noise(r: random.Random) -> bytes:
    return r.randbytes(r.randrange(60))


def _any_packet(r: random.Random) -> bytes:
    """Any instruction with any parameters, which mean something only by luck."""
    size = r.randrange(3000) if r.random() < _LONG else r.randrange(24)
    return codec.packet(_id(r), _instruction(r), r.randbytes(size))


def _instruction_packet(r: random.Random) -> bytes:
    """An instruction whose parameters are of the right form."""
    id, address = _id(r), r.randrange(700) if r.random() < 0.3 else r.randrange(64, 150)
    length = r.choice((1, 2, 4, WIDTH, r.randrange(300)))
    ids = r.sample(IDS, r.randint(1, len(IDS)))
    kind = r.randrange(10)
    if kind == 9:
        return codec.packet(id, 0x20, r.choice((b"\1CTRL", b"\2CTRL", r.randbytes(5))))  # control table backup
    if kind == 0:
        return codec.read(id, address, length)
    if kind == 1:
        return codec.write(id, address, r.randbytes(length % 16))
    if kind == 2:
        return codec.reg_write(id, address, r.randbytes(length % 16)) + codec.action(id)
    if kind == 3:
        return codec.sync_read(ids, address, length, fast=r.random() < 0.5)
    if kind == 4:
        width = length % 16
        return codec.sync_write(address, width, {i: r.randbytes(width) for i in ids})
    if kind == 5:
        return codec.bulk_read([(i, address, length) for i in ids], fast=r.random() < 0.5)
    if kind == 6:
        return codec.bulk_write([(i, address, r.randbytes(length % 16)) for i in ids])
    if kind == 7:
        return codec.clear(id) if r.random() < 0.5 else codec.ping(id)
    spare = r.choice(list(Reset))
    return codec.factory_reset(id, spare) if r.random() < 0.1 and id != codec.BROADCAST else codec.ping(id)


def _old_packet(r: random.Random) -> bytes:
    """An instruction of protocol 1.0; before some of them a servo is told to speak it."""
    kind = r.choice((1, 2, 3, 4, 5, 6, 8, 0x83, 0x92))
    id, params = _id(r), bytes([r.randrange(64, 150), r.choice((1, 2, 4))]) + r.randbytes(r.randrange(8))
    body = bytes([id, len(params) + 2, kind]) + params
    turn = codec.write(id, 13, b"\1") if id != codec.BROADCAST and r.random() < 0.01 else b""
    return turn + b"\xff\xff" + body + bytes([~sum(body) & 0xFF])


def _answers(r: random.Random) -> bytes:
    """What servos answer to a read of the control cycle, in one frame or one after the other."""
    error = r.choice((0, 0, 0, codec.ALERT, r.randrange(256)))
    data = {id: r.choice((r.randbytes(WIDTH), b"\xff\xff\xfd" * 3 + b"\xfd")) for id in IDS}
    if r.random() < 0.5:
        return codec.fast_status([(id, error, each) for id, each in data.items()])
    return b"".join(codec.status(id, error, each) for id, each in data.items())


def _witmotion(r: random.Random) -> bytes:
    kinds = (witmotion.ACCELERATION, witmotion.ANGULAR_VELOCITY, witmotion.ANGLES, witmotion.QUATERNION)
    made = b""
    for kind in r.sample(kinds, r.randint(1, 4)):
        frame = witmotion.HEAD + bytes([kind]) + r.randbytes(8)
        made += frame + bytes([sum(frame) & 0xFF])
    return made


def _bno08x(r: random.Random) -> bytes:
    first = r.randrange(256)
    made = b""
    for index in range(first, first + r.randint(1, 4)):
        body = struct.pack("<B", index & 0xFF) + r.randbytes(12) + bytes(3)
        made += bno08x.HEAD + body + bytes([sum(body) & 0xFF])
    return made


def _id(r: random.Random) -> int:
    return r.choice((r.choice(IDS), r.choice(IDS), BOARD_ID, r.randrange(codec.MAX_ID + 1), codec.BROADCAST))


def _instruction(r: random.Random) -> int:
    return r.choice(_RARE) if r.random() < 0.002 else r.choice((*_COMMON, r.choice((0x07, 0x20, 0x7F, 0x9B))))


_FAMILIES: tuple[Callable[[random.Random], bytes], ...] = (
    _noise, _any_packet, _instruction_packet, _instruction_packet, _answers, _answers, _witmotion, _bno08x,
    _old_packet,
)  # fmt: skip

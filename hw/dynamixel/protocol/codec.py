"""Packets of Dynamixel Protocol 2.0, to bytes and back. Pure: no port, no clock.

A packet is FF FF FD 00, ID, length (2), instruction, parameters, CRC (2). Between length and CRC an FD is stuffed after
each FF FF FD, so that no header can appear there. A status packet is one of instruction 0x55 whose first parameter is
the error byte. The answer to a fast read is a single frame from ID 0xFE, not stuffed, in which every servo adds its
error, ID, data and the CRC of all the bytes before.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator, Mapping, Sequence
from enum import IntEnum
from typing import NamedTuple

from servoid.hw.dynamixel.protocol.crc import blocks_are_right, crc16, crc16_after

HEADER = b"\xff\xff\xfd\x00"
BROADCAST = 0xFE
MAX_ID = 252
ALERT = 0x80  # bit of the error byte: the hardware error register is not zero; the packet's data are valid
MAX_LENGTH = 2048  # bytes of a packet that a parser waits for: above anything that 253 servos send in a control cycle
FRAME_BITS = 10  # of a byte on the line: start, eight of data, stop
OVERHEAD = 11  # bytes of a status packet without data
FAST_HEAD, FAST_BLOCK = 8, 4  # bytes of a fast frame before its first block, and of a block without data

_HEAD = struct.Struct("<4sBHB")
_RUNS_ON = b"\xff\xff\xfd"
STUFFED = b"\xff\xff\xfd\xfd"


class InstructionCode(IntEnum):
    PING = 0x01
    READ = 0x02
    WRITE = 0x03
    REG_WRITE = 0x04
    ACTION = 0x05
    FACTORY_RESET = 0x06
    REBOOT = 0x08
    CLEAR = 0x10
    STATUS = 0x55
    SYNC_READ = 0x82
    SYNC_WRITE = 0x83
    FAST_SYNC_READ = 0x8A
    BULK_READ = 0x92
    BULK_WRITE = 0x93
    FAST_BULK_READ = 0x9A


class StatusError(IntEnum):
    """Why a servo refused an instruction: the error byte of its answer without the alert bit."""

    NONE = 0
    RESULT = 1
    INSTRUCTION = 2
    CRC = 3
    DATA_RANGE = 4
    DATA_LENGTH = 5
    DATA_LIMIT = 6
    ACCESS = 7


class Reset(IntEnum):
    """What a factory reset spares."""

    ALL = 0xFF
    EXCEPT_ID = 0x01
    EXCEPT_ID_AND_BAUD = 0x02


CLEAR_REVOLUTIONS = b"\x01\x44\x58\x4c\x22"  # the option, and the key without which it is refused


class Packet(NamedTuple):
    """A packet as it came, with a good CRC. `params` are unstuffed, but for the frames of a fast read."""

    id: int
    instruction: int
    params: bytes


class Status(NamedTuple):
    """An answer of a servo. `error` is a StatusError, or a number that the protocol does not name."""

    id: int
    error: int
    alert: bool
    data: bytes


def stuff(body: bytes) -> bytes:
    """The body of a packet (instruction and parameters) in which no header can appear."""
    return body.replace(_RUNS_ON, STUFFED)


def unstuff(body: bytes) -> bytes:
    """The inverse of `stuff`."""
    return body.replace(STUFFED, _RUNS_ON)


def packet(id: int, instruction: int, params: bytes = b"") -> bytes:
    """A packet, stuffed and with its CRC. Raises ValueError for an impossible ID or too many parameters."""
    if not (0 <= id <= MAX_ID or id == BROADCAST):
        raise ValueError(f"no Dynamixel has ID {id}: it is 0 to {MAX_ID}, or {BROADCAST} for all")
    if _RUNS_ON in params:
        params = stuff(params)
    if len(params) + 3 > 0xFFFF:
        raise ValueError(f"{len(params)} bytes of parameters do not fit a packet")
    head = _HEAD.pack(HEADER, id, len(params) + 3, instruction) + params
    return head + crc16(head).to_bytes(2, "little")


# Instructions --------------------------------------------------------------------------------------------------------


def ping(id: int = BROADCAST) -> bytes:
    return packet(id, InstructionCode.PING)


def read(id: int, address: int, length: int) -> bytes:
    return packet(id, InstructionCode.READ, struct.pack("<HH", address, length))


def write(id: int, address: int, data: bytes) -> bytes:
    return packet(id, InstructionCode.WRITE, struct.pack("<H", address) + data)


def reg_write(id: int, address: int, data: bytes) -> bytes:
    return packet(id, InstructionCode.REG_WRITE, struct.pack("<H", address) + data)


def action(id: int = BROADCAST) -> bytes:
    return packet(id, InstructionCode.ACTION)


def reboot(id: int) -> bytes:
    return packet(id, InstructionCode.REBOOT)


def clear(id: int) -> bytes:
    """Forget whole turns: the present position becomes that within a turn."""
    return packet(id, InstructionCode.CLEAR, CLEAR_REVOLUTIONS)


def factory_reset(id: int, spare: Reset) -> bytes:
    return packet(id, InstructionCode.FACTORY_RESET, bytes([spare]))


def sync_read(ids: Sequence[int], address: int, length: int, *, fast: bool = False) -> bytes:
    """Read the same registers of many: each answers with a status packet, in the order of `ids`; or all in a frame."""
    instruction = InstructionCode.FAST_SYNC_READ if fast else InstructionCode.SYNC_READ
    return packet(BROADCAST, instruction, struct.pack("<HH", address, length) + bytes(_unique(ids)))


def sync_write(address: int, length: int, data: Mapping[int, bytes]) -> bytes:
    """Write the same registers of many. Nobody answers. Raises ValueError for data of another length."""
    body = bytearray(struct.pack("<HH", address, length))
    for id, value in data.items():
        if len(value) != length:
            raise ValueError(f"servo {id}: {len(value)} bytes to write, expected {length}")
        body.append(id)
        body += value
    return packet(BROADCAST, InstructionCode.SYNC_WRITE, bytes(body))


def bulk_read(parts: Sequence[tuple[int, int, int]], *, fast: bool = False) -> bytes:
    """Read (ID, address, length) of many, whose registers may differ."""
    _unique([id for id, _, _ in parts])
    instruction = InstructionCode.FAST_BULK_READ if fast else InstructionCode.BULK_READ
    return packet(BROADCAST, instruction, b"".join(struct.pack("<BHH", *part) for part in parts))


def bulk_write(parts: Sequence[tuple[int, int, bytes]]) -> bytes:
    """Write (ID, address, data) of many, whose registers may differ. Nobody answers."""
    _unique([id for id, _, _ in parts])
    body = b"".join(struct.pack("<BHH", id, address, len(data)) + data for id, address, data in parts)
    return packet(BROADCAST, InstructionCode.BULK_WRITE, body)


class SyncWriter:
    """Sync writes to the same servos tick after tick: all but the values is assembled once."""

    def __init__(self, ids: Sequence[int], address: int, width: int, *, signed: bool) -> None:
        code = {1: "b", 2: "h", 4: "i"}[width]
        self._ids = tuple(_unique(ids))
        self._start = struct.pack("<HH", address, width)
        self._body = struct.Struct("<" + f"B{code if signed else code.upper()}" * len(self._ids))

    def packet(self, values: Sequence[int]) -> bytes:
        """The packet that writes `values`, in the order of the IDs. Raises ValueError if one does not fit."""
        fields = [0] * (2 * len(self._ids))
        fields[::2], fields[1::2] = self._ids, values
        try:
            body = self._body.pack(*fields)
        except struct.error as error:
            raise ValueError(f"sync write of {list(values)}: {error}") from None
        return packet(BROADCAST, InstructionCode.SYNC_WRITE, self._start + body)


# Answers -------------------------------------------------------------------------------------------------------------


def status(id: int, error: int = 0, data: bytes = b"") -> bytes:
    """The answer of a servo; `error` with the alert bit."""
    return packet(id, InstructionCode.STATUS, bytes([error]) + data)


def fast_status(blocks: Sequence[tuple[int, int, bytes]]) -> bytes:
    """The answer to a fast read: (ID, error, data) of each servo in turn."""
    frame = bytearray(fast_head([len(data) for _, _, data in blocks]))
    for id, error, data in blocks:
        frame += bytes([error, id]) + data
        frame += crc16(frame).to_bytes(2, "little")
    return bytes(frame)


def as_status(received: Packet) -> Status | None:
    """The status that a packet is, or None: an instruction (an echo, another master) or an empty one."""
    if received.instruction != InstructionCode.STATUS or not received.params or received.id == BROADCAST:
        return None
    error = received.params[0]
    return Status(received.id, error & ~ALERT, bool(error & ALERT), received.params[1:])


def fast_head(lengths: Sequence[int]) -> bytes:
    """How the answer to a fast read of `lengths` bytes begins."""
    return _HEAD.pack(HEADER, BROADCAST, 1 + FAST_BLOCK * len(lengths) + sum(lengths), InstructionCode.STATUS)


def parse_fast(stream: bytes, ids: Sequence[int], lengths: Sequence[int]) -> list[Status | None]:
    """The blocks of the answer to a fast read of `lengths` bytes from `ids`; None for each that did not come whole.

    The answer may be cut short or damaged: a block counts when its place, its ID and its CRC are right. As the CRC goes
    on from block to block, that of a damaged one is taken as received, so that it does not spoil those after it.
    """
    blocks: list[Status | None] = [None] * len(ids)
    head = fast_head(lengths)
    start = stream.find(head)
    if start < 0:
        return blocks
    at = start + FAST_HEAD
    crc = crc16(head)
    for i, (id, size) in enumerate(zip(ids, lengths, strict=True)):
        end = at + 2 + size
        if end + 2 > len(stream):
            break
        crc = crc16(stream[at:end], crc)
        received = stream[end] | stream[end + 1] << 8
        if crc == received and stream[at + 1] == id:
            error = stream[at]
            blocks[i] = Status(id, error & ~ALERT, bool(error & ALERT), stream[at + 2 : end])
        crc = crc16_after(received)
        at = end + 2
    return blocks


def whole_fast(frame: bytes, head: bytes, ids: bytes, length: int) -> list[bytes] | None:
    """The data of each block if `frame` is the whole answer to a fast read of `length` bytes from `ids`: nothing before
    or after, no error, every CRC right. Else None, and `parse_fast`, which is slower, may tell what is good in it."""
    block = FAST_BLOCK + length
    if (
        block & 1
        or len(frame) != FAST_HEAD + block * len(ids)
        or not frame.startswith(head)
        or frame[FAST_HEAD + 1 :: block] != ids
        or any(frame[FAST_HEAD::block])
        or not blocks_are_right(frame, FAST_HEAD, block)
    ):
        return None
    return [frame[at : at + length] for at in range(FAST_HEAD + 2, len(frame), block)]


def whole_sync(stream: bytes, heads: Sequence[bytes], length: int) -> list[bytes] | None:
    """The same of the answers to a plain read, each of which must begin as in `heads` and hold nothing stuffed."""
    frame = OVERHEAD + length
    if len(stream) != frame * len(heads) or STUFFED in stream:
        return None
    data, at = [], 0
    for head in heads:
        end = at + frame
        if not stream.startswith(head, at) or crc16(stream[at : end - 2]) != stream[end - 2] | stream[end - 1] << 8:
            return None
        data.append(stream[at + 9 : end - 2])
        at = end
    return data


def status_head(id: int, length: int) -> bytes:
    """How the answer of a servo begins that has no error, no alert, and `length` bytes of data without stuffing."""
    return _HEAD.pack(HEADER, id, length + 4, InstructionCode.STATUS) + b"\0"


class PacketParser:
    """Finds packets in a stream that comes in pieces, among any garbage. It never raises and never grows without bound.

    Whatever does not turn out to be a packet with a good CRC is passed over byte by byte, so that a false header cannot
    swallow a packet behind it. `garbage` counts the bytes passed over, `bad_crc` the headers that led to none.
    """

    def __init__(self, max_length: int = MAX_LENGTH) -> None:
        self._buffer = bytearray()
        self._max = max_length
        self.garbage = 0
        self.bad_crc = 0

    def reset(self) -> None:
        """Forget what is half received."""
        self._buffer.clear()

    @property
    def pending(self) -> int:
        """Bytes that are held back because a packet may begin in them."""
        return len(self._buffer)

    def feed(self, data: bytes) -> list[Packet]:
        """Add received bytes; returns the packets that they complete, in order."""
        self._buffer += data
        return list(self._packets())

    def _packets(self) -> Iterator[Packet]:
        buffer = self._buffer
        at = 0
        while True:
            start = buffer.find(HEADER, at)
            if start < 0:
                self._drop(max(at, len(buffer) - len(HEADER) + 1))  # a header may be cut in two
                return
            found, end = self._at(start)
            if found is not None:
                yield found
                self.garbage += start
                del buffer[:end]
                at = 0
            elif end > len(buffer):  # not all there yet
                whole = self._behind(start, end)
                if whole is None:
                    self._drop(start)
                    return
                at = whole
            else:
                self.bad_crc += end > start + 1
                at = start + 1

    def _drop(self, count: int) -> None:
        self.garbage += count
        del self._buffer[:count]

    def _at(self, start: int) -> tuple[Packet | None, int]:
        """The packet whose header is at `start`, and its end; or None and an end beyond the buffer to wait for, or
        None and an end within it if there is no packet here."""
        buffer = self._buffer
        if len(buffer) < start + 7:
            return None, start + 7
        id = buffer[start + 4]
        length = buffer[start + 5] | buffer[start + 6] << 8
        end = start + 7 + length
        if not 3 <= length <= self._max - 7 or (id > MAX_ID and id != BROADCAST):
            return None, start + 1
        if end > len(buffer):
            return None, end
        frame = bytes(buffer[start:end])
        if crc16(frame[:-2]) != frame[-2] | frame[-1] << 8:
            return None, end
        params = frame[8:-2]
        if STUFFED in params and not (id == BROADCAST and frame[7] == InstructionCode.STATUS):
            params = unstuff(params)
        return Packet(id, frame[7], params), end

    def _behind(self, start: int, end: int) -> int | None:
        """Start of a whole packet behind an unfinished one, which stuffing forbids: so that one was cut short."""
        if len(self._buffer) > start + 4 and self._buffer[start + 4] == BROADCAST:
            return None  # a fast frame is not stuffed and may hold anything
        at = self._buffer.find(HEADER, start + 1)
        while at >= 0:
            if self._at(at)[0] is not None:
                return at
            at = self._buffer.find(HEADER, at + 1)
        return None


def _unique(ids: Sequence[int]) -> Sequence[int]:
    for id in ids:
        if not 0 <= id <= MAX_ID:
            raise ValueError(f"no Dynamixel has ID {id}: it is 0 to {MAX_ID}")
    if len(set(ids)) != len(ids):
        raise ValueError(f"an ID is asked twice: {sorted(ids)}")
    return ids

"""Packets of Dynamixel Protocol 1.0, which a servo of the X and MX series speaks once its protocol type is 1.

A packet is FF FF, ID, length, instruction or error, parameters, checksum. Addresses and lengths have one byte. Source:
ROBOTIS e-Manual, protocol 1.0.
"""

from __future__ import annotations

import struct
from collections.abc import Iterator

from servoid.hw.dynamixel.protocol.codec import MAX_ID, InstructionCode, Packet, Reset, StatusError

_HEADER = b"\xff\xff"
_BROADCAST = 0xFE
_LONGEST = 255  # bytes that are kept of what may be a packet
_ERRORS = {
    StatusError.NONE: 0, StatusError.INSTRUCTION: 64, StatusError.RESULT: 64, StatusError.CRC: 16,
}  # fmt: skip
_RANGE = 8  # of any other error
_HARDWARE = 1 | 4 | 32  # bits of the hardware error register that the error byte shows: voltage, heat, overload


class Protocol1Parser:
    """Finds instruction packets in a stream that comes in pieces, and says in protocol 2.0 what they ask for."""

    def __init__(self) -> None:
        self._buffer = bytearray()

    def reset(self) -> None:
        self._buffer.clear()

    def feed(self, data: bytes) -> list[Packet]:
        """Add received bytes; the packets that they complete. One of them is never longer than 255 bytes."""
        self._buffer += data
        packets = list(self._packets())
        del self._buffer[:-_LONGEST]
        return packets

    def _packets(self) -> Iterator[Packet]:
        buffer = self._buffer
        while (start := buffer.find(_HEADER)) >= 0:
            del buffer[:start]
            if len(buffer) < 4:
                return
            id, length = buffer[2], buffer[3]
            end = 4 + length
            if length < 2 or not (id <= MAX_ID or id == _BROADCAST):
                del buffer[:1]
            elif len(buffer) < end:
                return
            elif checksum(buffer[2 : end - 1]) != buffer[end - 1]:
                del buffer[:1]
            else:
                instruction, params = buffer[4], bytes(buffer[5 : end - 1])
                del buffer[:end]
                yield Packet(id, instruction, _params(instruction, params))


def status(id: int, error: StatusError, hardware: int, data: bytes) -> bytes:
    """The answer of a servo with that hardware error register."""
    body = bytes([id, len(data) + 2, _ERRORS.get(error, _RANGE) | hardware & _HARDWARE]) + data
    return _HEADER + body + bytes([checksum(body)])


def checksum(body: bytes | bytearray) -> int:
    """Of everything between header and checksum."""
    return ~sum(body) & 0xFF


def _params(instruction: int, params: bytes) -> bytes:
    """Parameters as protocol 2.0 has them. Those of an instruction that it does not know stay as they are."""
    if instruction == InstructionCode.READ and len(params) == 2:
        return struct.pack("<HH", *params)
    if instruction in (InstructionCode.WRITE, InstructionCode.REG_WRITE) and params:
        return struct.pack("<H", params[0]) + params[1:]
    if instruction == InstructionCode.SYNC_WRITE and len(params) >= 2:
        return struct.pack("<HH", *params[:2]) + params[2:]
    if instruction == InstructionCode.FACTORY_RESET:
        return bytes([Reset.ALL])
    return params

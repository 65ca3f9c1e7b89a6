"""CRC-16 of Protocol 2.0: polynomial 0x8005, most significant bit first, starting at 0 (CRC-16/UMTS)."""

from __future__ import annotations

import struct

import numpy as np

_POLYNOMIAL = 0x8005


def _byte_table() -> list[int]:
    table = []
    for byte in range(256):
        crc = byte << 8
        for _ in range(8):
            crc = (crc << 1) ^ (_POLYNOMIAL if crc & 0x8000 else 0)
        table.append(crc & 0xFFFF)
    return table


def _word_table(byte_table: list[int]) -> list[int]:
    """The checksum of every two bytes: a 16-bit remainder is wholly replaced by them, which halves the steps."""
    single = np.array(byte_table, dtype=np.uint32)
    words = np.arange(65536, dtype=np.uint32)
    first = single[words >> 8]
    table: list[int] = (((first << 8) & 0xFFFF) ^ single[(first >> 8) ^ (words & 0xFF)]).tolist()
    return table


_BYTES = _byte_table()
_WORDS = _word_table(_BYTES)
_UNPACK = [struct.Struct(f">{n}H").unpack_from for n in range(64)]  # packets of the control cycle are short


def crc16(data: bytes | bytearray | memoryview, crc: int = 0) -> int:
    """Checksum of `data`, going on from `crc`."""
    n = len(data) >> 1
    unpack = _UNPACK[n] if n < 64 else struct.Struct(f">{n}H").unpack_from
    words = _WORDS
    for word in unpack(data):
        crc = words[crc ^ word]
    if len(data) & 1:
        crc = ((crc << 8) & 0xFFFF) ^ _BYTES[(crc >> 8) ^ data[-1]]
    return crc


def crc16_after(crc: int) -> int:
    """Checksum of what has checksum `crc` followed by those two bytes themselves, low byte first."""
    return _WORDS[crc ^ ((crc & 0xFF) << 8 | crc >> 8)]


def blocks_are_right(frame: bytes, first: int, block: int) -> bool:
    """Whether every block of `block` bytes from `first` on ends with the checksum of all that is before it in `frame`.
    Both numbers must be even: two bytes are taken at a time."""
    words = struct.unpack(f">{len(frame) >> 1}H", frame)
    table, crc, step = _WORDS, 0, block >> 1
    for word in words[: first >> 1]:
        crc = table[crc ^ word]
    for at in range((first >> 1) + step - 1, len(words), step):
        for word in words[at - step + 1 : at]:
            crc = table[crc ^ word]
        if words[at] != (crc & 0xFF) << 8 | crc >> 8:
            return False
        crc = table[crc ^ words[at]]
    return True

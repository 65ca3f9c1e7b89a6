"""Frames of a fixed size in a stream of bytes: found by their head, believed by their checksum."""

from __future__ import annotations

from collections.abc import Callable
from typing import NamedTuple


class Scan(NamedTuple):
    """What a stretch of bytes held."""

    frames: list[bytes]
    rest: bytes  # the beginning of a frame, shorter than one: put it before what comes next
    garbage: int  # bytes that belong to no frame
    bad: int  # places that looked like a frame but for their checksum or content


def scan(data: bytes, head: bytes, size: int, good: Callable[[bytes], bool]) -> Scan:
    """Every frame in `data`: `size` bytes that begin with `head` and are `good`.

    Whatever looks like a frame and is none gives up its first byte only, so that a frame which begins inside of it is
    found. Time is linear in `data`. Pure; never raises.
    """
    found: list[bytes] = []
    garbage = bad = at = 0
    while True:
        start = data.find(head, at)
        if start < 0:
            start = len(data) - _beginning(data[at:], head)
            return Scan(found, data[start:], garbage + start - at, bad)
        garbage += start - at
        frame = data[start : start + size]
        if len(frame) < size:
            return Scan(found, frame, garbage, bad)
        if good(frame):
            found.append(frame)
            at = start + size
        else:
            bad += 1
            garbage += 1
            at = start + 1


def _beginning(data: bytes, head: bytes) -> int:
    """How many bytes at the end of `data` could begin a head."""
    longest = min(len(head) - 1, len(data))
    return next((n for n in range(longest, 0, -1) if data.endswith(head[:n])), 0)

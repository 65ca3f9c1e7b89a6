"""Waiting for what another process, a thread or a device does."""

from __future__ import annotations

import fcntl
import os
import struct
import termios
import time
from collections.abc import Callable

_STEP = 0.01  # s between two looks
_LOOKS = 12_000  # two minutes: a busy machine may take its time, and what never happens is to fail


def until(condition: Callable[[], object], otherwise: str = "it did not happen") -> None:
    """Wait until `condition` is true. Raises AssertionError with the reason `otherwise` when it never is."""
    for _ in range(_LOOKS):
        if condition():
            return
        time.sleep(_STEP)
    raise AssertionError(otherwise)


def type_in(person: int, program: int, text: bytes) -> None:
    """Type at a pseudo-terminal, and wait until all of it is at the program's end: the kernel takes its time."""
    before = _unread(program)
    os.write(person, text)
    until(lambda: _unread(program) >= before + len(text), "what was typed did not arrive")


def _unread(terminal: int) -> int:
    count: int = struct.unpack("i", fcntl.ioctl(terminal, termios.FIONREAD, bytes(4)))[0]
    return count

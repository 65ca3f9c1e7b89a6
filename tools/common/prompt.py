"""Questions to the person at the robot. They go to standard error, so that `--json` keeps standard output."""

from __future__ import annotations

import contextlib
import os
import select
import sys
import termios

from servoid.hw.config import ConfigError

YES = ("", "y", "yes")


class Cancelled(KeyboardInterrupt):
    """The person said no: the command ends as after Ctrl-C."""


def confirm(text: str, remedy: str = "give --yes to continue without being asked") -> None:
    """Return when the person presses Enter, or answers y.

    What was typed or pasted before the question is no answer to it and is thrown away. Raises Cancelled for any other
    answer, and ConfigError with `remedy` when nobody is there.
    """
    _discard_typed()
    print(f"{text}. Press Enter to continue, Ctrl-C to cancel: ", end="", file=sys.stderr, flush=True)
    answer = _read_line()
    if answer is None:
        print(file=sys.stderr)
        raise ConfigError(f"nobody is there to press Enter: {remedy}")
    if answer.strip().lower() not in YES:
        raise Cancelled(f"cancelled: the answer was '{answer.strip()[:40]}', neither Enter nor y")


def _descriptor() -> int | None:
    """Standard input as a file descriptor; None where a program has put something else in its place."""
    try:
        return sys.stdin.fileno()
    except (AttributeError, OSError, ValueError):
        return None


def _discard_typed() -> None:
    """Throw away what waits at standard input, be it a terminal, a pipe or a file."""
    descriptor = _descriptor()
    if descriptor is None:
        return
    with contextlib.suppress(termios.error):  # not a terminal
        termios.tcflush(descriptor, termios.TCIFLUSH)
    while select.select([descriptor], [], [], 0.0)[0] and os.read(descriptor, 4096):
        pass


def _read_line() -> str | None:
    """The next line, or None at the end of the input. Python's own buffer would keep the lines after it for the next
    question, where nothing could throw them away."""
    descriptor = _descriptor()
    if descriptor is None:
        return sys.stdin.readline() or None
    line = b""
    while not line.endswith(b"\n"):
        character = os.read(descriptor, 1)
        if not character:
            return None
        line += character
    return line.decode(errors="replace")

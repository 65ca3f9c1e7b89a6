"""Questions to the person at the robot. They go to standard error, so that `--json` keeps standard output."""

from __future__ import annotations

import sys

from hw.config import ConfigError


def confirm(text: str, remedy: str = "give --yes to go on without being asked") -> None:
    """Wait for Enter. Raises ConfigError with `remedy` when nobody is there."""
    print(f"{text}. Enter to go on, Ctrl-C to leave: ", end="", file=sys.stderr, flush=True)
    if not sys.stdin.readline():
        print(file=sys.stderr)
        raise ConfigError(f"nobody is there to press Enter: {remedy}")

"""Waiting for what another process, a thread or a device does."""

from __future__ import annotations

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

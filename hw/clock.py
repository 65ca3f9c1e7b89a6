"""The machine's own time."""

from __future__ import annotations

import ctypes
import time

_PR_SET_TIMERSLACK = 29


class WallClock:
    """The machine's monotonic clock. Sleeps are to an absolute deadline, so errors do not add up."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def sleep_until(self, time_ns: int) -> None:
        while (left := time_ns - time.monotonic_ns()) > 0:
            time.sleep(left * 1e-9)


def wake_sharply() -> None:
    """Let this thread's sleeps end within a microsecond, where Linux usually allows itself 50: a control cycle has one
    sleep for each answer on the bus. Elsewhere it does nothing."""
    libc = ctypes.CDLL(None)
    if hasattr(libc, "prctl"):
        libc.prctl(_PR_SET_TIMERSLACK, 1000)

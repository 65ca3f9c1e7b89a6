"""The machine's own time."""

from __future__ import annotations

import time


class WallClock:
    """The machine's monotonic clock. Sleeps are to an absolute deadline, so errors do not add up."""

    def now_ns(self) -> int:
        return time.monotonic_ns()

    def sleep_until(self, time_ns: int) -> None:
        while (left := time_ns - time.monotonic_ns()) > 0:
            time.sleep(left * 1e-9)

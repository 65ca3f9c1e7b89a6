"""Minimum-jerk motions between two poses (Flash and Hogan, 1985)."""

from __future__ import annotations

from servoid.hw.contracts.body import Array

MIN_JERK_PEAK = 1.875  # highest over mean speed


class MinJerk:
    """The way from one pose to another in so many ticks, one sample a call, and then the other pose."""

    def __init__(self, start: Array, end: Array, ticks: int) -> None:
        self._start, self._end, self._ticks, self._tick = start, end, max(1, ticks), 0

    @property
    def done(self) -> bool:
        return self._tick >= self._ticks

    def next(self) -> Array:
        self._tick = min(self._tick + 1, self._ticks)
        return self.ahead(0)

    def ahead(self, ticks: int) -> Array:
        """Where so many more calls of `next` will be."""
        s = min(self._tick + ticks, self._ticks) / self._ticks
        return self._start + (self._end - self._start) * (10 * s**3 - 15 * s**4 + 6 * s**5)

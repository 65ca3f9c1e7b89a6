"""Time: the machine's clock, a simulated one in step with the wall, and the schedule that a loop keeps.

A simulated clock belongs to its backend: `sleep_until` advances the physics and `now_ns` is simulated time.
"""

from __future__ import annotations

from dataclasses import dataclass

from servoid.hw.clock import WallClock as WallClock
from servoid.hw.contracts.body import Clock


class RealTime:
    """A simulated clock that also lets wall time pass, for a person who watches.

    Time is the simulation's, so that a run has the same result at any speed. When the machine falls behind, the wall
    schedule starts anew from there instead of hurrying after it; `late_ns` says how late the newest wake-up was.
    """

    def __init__(self, clock: Clock, wall: Clock | None = None) -> None:
        self._clock = clock
        self._wall = wall or WallClock()
        self._offset: int | None = None  # wall time less simulated time
        self.late_ns = 0

    def now_ns(self) -> int:
        return self._clock.now_ns()

    def sleep_until(self, time_ns: int) -> None:
        """Advance the simulation to `time_ns`, then wait until as much wall time has passed."""
        if self._offset is None:
            self._offset = self._wall.now_ns() - self._clock.now_ns()
        step = time_ns - self._clock.now_ns()
        self._clock.sleep_until(time_ns)
        self._wall.sleep_until(time_ns + self._offset)
        self.late_ns = self._wall.now_ns() - time_ns - self._offset
        if step > 0 and self.late_ns >= step:
            self._offset += self.late_ns


@dataclass(frozen=True, slots=True)
class Wake:
    """A tick of the schedule."""

    tick: int
    missed: int  # ticks that were skipped before it; behind a RealTime clock they are wall ticks only
    late_ns: int


class Schedule:
    """Deadlines at a fixed rate, from the moment of its making: tick 0 at once, tick k at k periods.

    A loop that was held up wakes at the newest deadline that has passed. The ticks between are counted as missed and
    are never replayed. Behind a `RealTime` clock no simulated tick is ever skipped: being late is counted, but changes
    nothing in the run.
    """

    def __init__(self, clock: Clock, rate: int) -> None:
        self._clock = clock
        self._period = round(1e9 / rate)
        self._start = clock.now_ns()
        self._next = 0
        self.missed = 0

    def wait(self) -> Wake:
        """Sleep until the next deadline."""
        deadline = self._start + self._next * self._period
        self._clock.sleep_until(deadline)
        if isinstance(self._clock, RealTime):
            late, skipped = self._clock.late_ns, 0
            missed = late // self._period
        else:
            late = max(0, self._clock.now_ns() - deadline)
            missed = skipped = late // self._period
        tick = self._next + skipped
        self._next = tick + 1
        self.missed += missed
        return Wake(tick, missed, late - skipped * self._period)

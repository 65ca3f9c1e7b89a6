"""The line that a person watches during a run."""

from __future__ import annotations

import math
import time
from collections import deque
from typing import TextIO

import numpy as np

from servoid.stack.log.tick import TickRecord
from servoid.stack.safety.guard import Phase
from servoid.tools.common.output import Screen

WINDOW = 250  # ticks that the timing is taken over
INTERVAL = {True: 0.1, False: 1.0}  # s between updates: of the wall on a terminal, of the robot elsewhere


class LiveLine:
    """Call it with each tick. On a terminal the line is rewritten in place, elsewhere a new one comes each second.

    It never waits, and a stream that cannot be written to does not end the run.
    """

    def __init__(self, stream: TextIO) -> None:
        self._screen = Screen(stream)
        self._tty = self._screen.tty
        self._busy: deque[float] = deque(maxlen=WINDOW)
        self._shown = -math.inf
        self._start_ns: int | None = None
        self._width = 0

    def __call__(self, record: TickRecord) -> None:
        timing = record.timing
        self._busy.append(
            (timing.read + timing.estimate + timing.act + timing.guard + timing.write + timing.record) * 1e-6
        )
        if record.proposal.instruction is not None and self._start_ns is None:
            self._start_ns = record.observation.time_ns
        now = time.monotonic() if self._tty else record.observation.time_ns * 1e-9
        if now - self._shown >= INTERVAL[self._tty]:
            self._shown = now
            self._show(self.text(record))

    def text(self, record: TickRecord) -> str:
        """Phase or time, what the task is about, tilt, and how long ticks take."""
        parts = [f"{record.phase:>8}"]
        if self._start_ns is not None and record.phase is Phase.RUNNING:
            parts = [f"{(record.observation.time_ns - self._start_ns) * 1e-9:6.1f} s"]
        state, instruction = record.state, record.proposal.instruction
        if state is not None and instruction is not None:
            vx, vy = state.velocity[:2]
            if instruction.goal is not None:
                parts.append(f"goal {float(np.linalg.norm(instruction.goal)):5.2f} m")
            else:
                asked = instruction.velocity
                parts.append(f"asked {asked[0]:+.2f} {asked[1]:+.2f} m/s {asked[2]:+.2f} rad/s")
            parts.append(f"speed {math.hypot(vx, vy):.2f} m/s")
        if state is not None:
            tilt = math.degrees(math.acos(min(1.0, max(-1.0, -float(state.gravity[2])))))
            parts.append(f"tilt {tilt:4.1f} deg")
        median, worst = np.percentile(np.array(self._busy), [50, 99])
        parts.append(f"tick {median:.1f} ms, p99 {worst:.1f}")
        return "  ".join(parts)

    def close(self) -> None:
        """Leave the last line standing."""
        if self._tty and self._width:
            self._screen.write("\n")

    def _show(self, text: str) -> None:
        if not self._tty:
            self._screen.write(text + "\n")
        elif self._screen.write("\r" + text.ljust(self._width)):
            self._width = len(text)

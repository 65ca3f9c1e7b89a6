"""The line that a person watches during a run."""

from __future__ import annotations

import math
import time
from collections import deque
from typing import TextIO

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.stack.log.tick import TickRecord
from servoid.stack.safety.phase import Phase
from servoid.tools.common.output import Screen

WINDOW = 250  # ticks that the timing is taken over
REWRITTEN = 0.1  # s of the wall between updates of a line that is rewritten
SPARSE = 5.0  # s of the robot between lines where none can be rewritten


class LiveLine:
    """Call it with each tick. A terminal's line is rewritten in place; elsewhere, or where the terminal is dumb, a new
    one comes when the phase changes, and every few seconds.

    It never waits, and a stream that cannot be written to does not end the run.
    """

    def __init__(self, stream: TextIO, term: str | None = None, interval: float = REWRITTEN) -> None:
        """`term` is the kind of terminal, that of the environment unless given; `interval` [s] between updates."""
        self._screen, self._interval = Screen(stream, term), interval
        self._busy: deque[float] = deque(maxlen=WINDOW)
        self._shown = -math.inf
        self._phase: Phase | None = None  # of the line before
        self._start_ns: int | None = None

    def __call__(self, record: TickRecord) -> None:
        timing = record.timing
        self._busy.append(
            (timing.read + timing.estimate + timing.act + timing.guard + timing.write + timing.record) * 1e-6
        )
        if record.proposal.instruction is not None and self._start_ns is None:
            self._start_ns = record.observation.time_ns
        if self._screen.rewrites:
            now = time.monotonic()
            if now - self._shown >= self._interval:
                self._shown = now
                self._screen.rewrite(self.text(record, self._screen.columns))
            return
        now, asks = record.observation.time_ns * 1e-9, record.proposal.instruction is not None
        if record.phase is Phase.RUNNING and not asks:  # nothing to tell yet
            return
        if record.phase != self._phase or now - self._shown >= SPARSE:
            self._shown, self._phase = now, record.phase
            self._screen.write(self.text(record) + "\n")

    def text(self, record: TickRecord, columns: int | None = None) -> str:
        """Phase or time of the task, what it is about, tilt, and how long ticks take: as much as fits the columns."""
        parts = [f"{record.phase:>8}"]
        if self._start_ns is not None and record.phase is Phase.RUNNING:
            parts = [f"{(record.observation.time_ns - self._start_ns) * 1e-9:6.1f} s"]
        state, instruction = record.state, record.proposal.instruction
        if state is not None and instruction is not None:
            vx, vy = state.velocity[:2]
            parts.append(asked(instruction.velocity, instruction.goal, instruction.text))
            parts.append(f"speed {math.hypot(vx, vy):.2f} m/s")
        if state is not None:
            tilt = math.degrees(math.acos(min(1.0, max(-1.0, -float(state.gravity[2])))))
            parts.append(f"tilt {tilt:4.1f} deg")
        median, worst = np.percentile(np.array(self._busy), [50, 99])
        parts += [f"tick {median:.1f} ms", f"p99 {worst:.1f}"]
        while columns is not None and len(parts) > 1 and len("  ".join(parts)) > columns:
            parts.pop()
        return "  ".join(parts)

    def close(self) -> None:
        """Leave the last line standing."""
        self._screen.end()


def asked(velocity: Array, goal: Array | None = None, text: str | None = None) -> str:
    """What is asked of the robot: a goal's distance `(2,)` m, a sentence or a velocity `(3,)` m/s, m/s, rad/s."""
    if goal is not None:
        return f"goal {float(np.linalg.norm(goal)):5.2f} m"
    if text:
        return f"asked '{text}'"
    return f"asked {velocity[0]:+z.2f} {velocity[1]:+z.2f} m/s {velocity[2]:+z.2f} rad/s"

"""The line that a person watches never holds the robot up."""

from __future__ import annotations

import io
import os
import pty
import select
import signal
import termios
from collections.abc import Iterator
from types import SimpleNamespace
from typing import Any, TextIO

import numpy as np
import pytest
from waiting import until

from servoid.stack.runtime.run import RunSettings, run
from servoid.tools.common.live import LiveLine, asked
from servoid.tools.common.output import Progress, Screen

TIMING = SimpleNamespace(read=0, estimate=0, act=0, guard=0, write=0, record=0)


@pytest.fixture
def terminal() -> Iterator[tuple[int, TextIO]]:
    """What a person types into and reads from, and the stream of a program in it; who waits for it too long fails."""

    def ring(*_: Any) -> None:
        raise TimeoutError("it waits for the terminal")

    before = signal.signal(signal.SIGALRM, ring)
    signal.setitimer(signal.ITIMER_REAL, 120.0)
    person, program = pty.openpty()
    stream = os.fdopen(program, "w")
    try:
        yield person, stream
    finally:
        signal.setitimer(signal.ITIMER_REAL, 0.0)
        signal.signal(signal.SIGALRM, before)
        os.close(person)
        stream.close()


def takes(stream: TextIO) -> bool:
    """Whether the terminal takes more now."""
    return bool(select.select([], [stream], [], 0.0)[1])


def record(time_ns: int) -> Any:
    observation, proposal = SimpleNamespace(time_ns=time_ns), SimpleNamespace(instruction=None)
    return SimpleNamespace(timing=TIMING, proposal=proposal, observation=observation, state=None, phase="homing")


def test_a_terminal_that_ctrl_s_stopped_is_not_waited_for(
    terminal: tuple[int, TextIO],
) -> None:
    person, stream = terminal
    line = LiveLine(stream, "xterm", interval=0.0)
    line(record(0))
    os.write(person, b"\x13")
    until(lambda: not takes(stream), "Ctrl-S did not stop it")
    for i in range(100):
        line(record(i))  # who waits, waits for ever
    line.close()
    os.read(person, 1000)
    os.write(person, b"\x11")  # Ctrl-Q
    until(lambda: takes(stream), "Ctrl-Q did not let it go on")
    line(record(101))
    assert b"homing" in os.read(person, 1000)


def test_a_terminal_that_nobody_reads_is_not_waited_for(terminal: tuple[int, TextIO]) -> None:
    """As that of an ssh connection that hangs: it takes some, and then no more."""
    screen = Screen(terminal[1])
    written = [screen.write("\r" + "x" * 100) for _ in range(3000)]
    assert written[0]
    assert not written[-1]


class Gone(io.StringIO):
    """A terminal whose reader has left."""

    tries = 0

    def isatty(self) -> bool:
        return True

    def write(self, text: str) -> int:
        self.tries += 1
        raise BrokenPipeError("gone")


def test_a_reader_that_left_does_not_end_the_run() -> None:
    stream = Gone()
    line = LiveLine(stream, "xterm")
    result = run(RunSettings("stand", policy="gait", seconds=0.4), on_tick=line)
    line.close()
    assert result.outcome == "succeeded"
    assert stream.tries == 1


class Lines(io.StringIO):
    """What a terminal that is not dumb, or one that is, was sent."""

    def isatty(self) -> bool:
        return True


def walking(second: float, phase: str = "running") -> Any:
    """A tick of a walk, with all that a line can tell."""
    state = SimpleNamespace(velocity=np.array([0.1, 0.0, 0.0]), gravity=np.array([0.0, 0.0, -1.0]))
    instruction = SimpleNamespace(velocity=np.array([0.1, 0.0, 0.5]), goal=None, text=None)
    return SimpleNamespace(
        timing=TIMING,
        proposal=SimpleNamespace(instruction=instruction),
        observation=SimpleNamespace(time_ns=round(second * 1e9)),
        state=state,
        phase=phase,
    )


@pytest.mark.parametrize("columns", [40, 60, 80, 120])
def test_the_line_fits_the_terminal_as_it_is_now(terminal: tuple[int, TextIO], columns: int) -> None:
    person, stream = terminal
    line = LiveLine(stream, "xterm", interval=0.0)
    for now in (120, columns):  # a person pulls the window smaller
        termios.tcsetwinsize(stream.fileno(), (24, now))
        line(walking(1.0))
    line.close()
    shown = ""
    while not shown.endswith("\n"):
        shown += os.read(person, 1000).decode()
    last = shown.rstrip().split("\r")[-1]
    assert 6 < len(last) < columns
    assert ("asked" in last) == (columns > 50)


def test_a_terminal_that_cannot_rewrite_a_line_gets_few() -> None:
    stream = Lines()
    line = LiveLine(stream, "dumb")
    for tick in range(600):  # 12 s
        line(walking(tick * 0.02, "homing" if tick < 50 else "running"))
    line.close()
    assert "\r" not in stream.getvalue()
    assert len(stream.getvalue().splitlines()) == 4  # homing, running, and every five seconds


@pytest.mark.parametrize(("term", "shown"), [("dumb", "filming: 0 % of 100\n"), ("xterm", "\rfilming: 0 % of 100")])
def test_progress_is_one_line_where_it_can_be_rewritten(term: str, shown: str) -> None:
    stream = Lines()
    with Progress("filming", stream, term) as progress:
        for done in range(100):
            progress(done, 100)
    assert stream.getvalue().startswith(shown)
    assert stream.getvalue().endswith("\n" if term == "dumb" else " \r")  # a line that was rewritten is taken away
    assert len(stream.getvalue().splitlines()) < 4


def test_a_speed_that_rounds_to_nothing_has_no_minus() -> None:
    assert asked(np.array([-0.001, 0.1, -0.5])) == "asked +0.00 +0.10 m/s -0.50 rad/s"

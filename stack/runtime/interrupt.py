"""Ctrl-C and other reasons to stop as requests, not as exceptions: a write to the motors is never cut in half."""

from __future__ import annotations

import signal
import threading
from collections.abc import Callable, Sequence
from dataclasses import dataclass
from types import FrameType
from typing import Any

from servoid.hw.signals import importing, ordinary_stack
from servoid.stack.safety.event import Event

# Whatever ends a process, or freezes it, and can be handled: a robot that walks is brought to rest first. Of these a
# program around this one may have given some a meaning of its own, or `nohup` told it to go on: then it does.
ALWAYS = (signal.SIGINT, signal.SIGTERM)
ELSE = (
    *(signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP, signal.SIGUSR1, signal.SIGUSR2, signal.SIGALRM),
    *(signal.SIGVTALRM, signal.SIGPROF, signal.SIGXCPU, signal.SIGIO, signal.SIGPWR),
)
# Of a terminal that this process is in the background of: they would freeze it.
IGNORED = (signal.SIGTTIN, signal.SIGTTOU)

ONCE = "interrupted: stopping; once more for torque off at once"
TWICE = "interrupted twice: torque off at once"
OFF = "a person asked for torque off at once"


class Interrupt:
    """Counts the signals that ask to end while it is entered, and restores the handlers after.

    A terminal that closes, or an ssh connection that is lost, sends SIGHUP, often more than once and with a SIGTERM
    behind it: all of that is one request. The first request asks for an orderly end, the second for torque off at once.
    A policy that hangs would never look: while `breakable` is set, and only then, the second also raises
    KeyboardInterrupt. Outside the main thread, where Python forbids handlers, it stays at zero unless `request` is
    called.

    Before anything moves it may be `eager`, and raise at once, but not into a library that is being imported, which may
    make another error of it; one that is cleaning up may lose it. What was counted is not lost: `check` and `settle`
    raise it.
    """

    def __init__(self, *, eager: bool = False) -> None:
        self.eager = eager
        self.count = 0
        self.breakable = False
        self._handlers: dict[signal.Signals, Any] = {}
        self._hung_up = self._terminated = False

    def request(self) -> None:
        """The same as one Ctrl-C."""
        self.count += 1

    def check(self) -> None:
        """Raise KeyboardInterrupt for a signal that came while it could not be raised."""
        if self.count:
            raise KeyboardInterrupt

    def settle(self) -> None:
        """End of being eager: signals are requests from here on. Raises KeyboardInterrupt for one that came before."""
        self.eager = False
        ordinary_stack()  # what was loaded since may have given this thread another
        self.check()

    def __enter__(self) -> Interrupt:
        if threading.current_thread() is threading.main_thread():
            ordinary_stack()
            free = [number for number in (*ELSE, *IGNORED) if signal.getsignal(number) is signal.SIG_DFL]
            for number in (*ALWAYS, *free):
                handler = signal.SIG_IGN if number in IGNORED else self._handle
                self._handlers[number] = signal.signal(number, handler)
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers.clear()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        if not self._same(number):
            self.count += 1
        if (self.eager and not importing(frame)) or (self.count > 1 and self.breakable):
            raise KeyboardInterrupt

    def _same(self, number: int) -> bool:
        """Whether a signal says again what a hang-up and what comes with it have said."""
        again = self._hung_up or self._terminated
        if number == signal.SIGHUP:
            self._hung_up = True
            return again
        again = self._hung_up and not self._terminated
        self._terminated |= number == signal.SIGTERM
        return again and number == signal.SIGTERM


@dataclass(frozen=True, slots=True)
class Stop:
    """A reason to end that came from outside the robot."""

    kind: str
    text: str
    at_once: bool = False  # without lowering


class Stops:
    """All such reasons in one place: Ctrl-C, what a person `asked` elsewhere, a log that cannot be written, and, when a
    recorded run is repeated, the ones that its log tells of."""

    def __init__(
        self,
        interrupt: Interrupt,
        failure: Callable[[], str | None] = lambda: None,
        script: Sequence[Event] = (),
        asked: Callable[[], Stop | None] = lambda: None,
    ) -> None:
        self._interrupt, self._failure, self._script, self._asked = interrupt, failure, script, asked

    def at(self, tick: int) -> Stop | None:
        """The reason to stop at a tick, the strongest first."""
        due = [event for event in self._script if event.tick <= tick]
        asked = self._asked()
        if asked is not None and asked.at_once:
            return asked
        if self._interrupt.count > 1 or any(event.text == TWICE for event in due):
            return Stop("interrupt", TWICE, at_once=True)
        if self._interrupt.count == 1:
            return Stop("interrupt", ONCE)
        if asked is not None:
            return asked
        if due:
            return Stop(due[0].kind, due[0].text)
        failure = self._failure()
        return Stop("record", failure) if failure is not None else None

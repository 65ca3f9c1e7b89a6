"""Ctrl-C as a request, not as an exception: a write to the motors is never cut in half."""

from __future__ import annotations

import signal
import threading
from types import FrameType
from typing import Any


class Interrupt:
    """Counts SIGINT and SIGTERM while it is entered, and restores the handlers after.

    The first asks for an orderly end, the second for torque off at once. A policy that hangs would never look: while
    `breakable` is set, and only then, the second signal also raises KeyboardInterrupt. Outside the main thread, where
    Python forbids handlers, it stays at zero unless `request` is called.
    """

    def __init__(self) -> None:
        self.count = 0
        self.breakable = False
        self._handlers: dict[signal.Signals, Any] = {}

    def request(self) -> None:
        """The same as one Ctrl-C."""
        self.count += 1

    def __enter__(self) -> Interrupt:
        if threading.current_thread() is threading.main_thread():
            for number in (signal.SIGINT, signal.SIGTERM):
                self._handlers[number] = signal.signal(number, self._handle)
        return self

    def __exit__(self, *exception: object) -> None:
        for number, handler in self._handlers.items():
            signal.signal(number, handler)
        self._handlers.clear()

    def _handle(self, number: int, frame: FrameType | None) -> None:
        self.count += 1
        if self.count > 1 and self.breakable:
            raise KeyboardInterrupt

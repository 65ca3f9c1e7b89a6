"""A serial port that never blocks for ever, is nobody else's, and fails in one way only: BackendError.

On Linux a port that vanishes raises termios.error, which is neither an OSError nor a SerialException, and an adapter
that stops draining blocks a plain write for ever: neither must reach a loop with torque on.
"""

from __future__ import annotations

import fcntl
import os
import select
import termios
import time
from contextlib import suppress
from pathlib import Path
from typing import Protocol

import serial

from servoid.hw.contracts.body import BackendError, Clock
from servoid.hw.dynamixel.transport.openers import openers

WRITE_SECONDS = 0.02  # that an adapter may take to accept a packet: 40 times what the longest needs at 2 Mbit/s
_POLL_NS = 50_000  # between looks while a line is drained
_CHUNK = 4096  # bytes of a read: above any answer, and what a terminal holds
_NO_COUNT = bytes(4)


class Port(Protocol):
    """What the bus needs of a port. Every method raises BackendError when the port is gone."""

    name: str

    @property
    def baud(self) -> int: ...

    def set_baud(self, baud: int) -> None: ...

    def write(self, data: bytes) -> None:
        """Hand all of `data` to the adapter, or raise."""
        ...

    def read(self) -> bytes:
        """What has come so far, at once, or nothing."""
        ...

    def close(self) -> None: ...


class SerialPort:
    """A tty, locked for this process (and those that inherit it), with low latency where the driver has it."""

    def __init__(self, name: str | Path, baud: int) -> None:
        """Raises BackendError when it cannot be opened, with the remedy."""
        self.name = str(name)
        if others := openers(self.name):
            raise BackendError(f"{self.name}: another program has the port: {', '.join(others)}: end it first")
        try:
            self._serial = serial.Serial(self.name, baud, timeout=0, write_timeout=0, exclusive=True)
        except (OSError, ValueError, termios.error) as error:
            raise BackendError(_cannot_open(self.name, baud, error)) from error
        self._fd: int = self._serial.fileno()
        self._ask_low_latency()
        self._exclusive(True)

    @property
    def baud(self) -> int:
        return self._serial.baudrate

    def fileno(self) -> int:
        return self._fd

    def set_baud(self, baud: int) -> None:
        try:
            self._serial.baudrate = baud
        except (OSError, ValueError, termios.error) as error:
            raise BackendError(f"{self.name}: cannot be set to {baud} bit/s: {error}") from error

    def write(self, data: bytes) -> None:
        deadline = 0.0
        while data:
            try:
                sent = os.write(self._fd, data)
            except BlockingIOError:
                sent = 0
            except (OSError, ValueError, termios.error) as error:
                raise self._gone(error) from error
            data = data[sent:]
            if data:
                now = time.monotonic()
                deadline = deadline or now + WRITE_SECONDS
                self._wait_writable(deadline - now)

    def read(self) -> bytes:
        try:
            data = os.read(self._fd, _CHUNK)
            if not data:
                # Reading cannot tell silence from a port that is gone: both give nothing. Asking how much there is can.
                fcntl.ioctl(self._fd, termios.TIOCINQ, _NO_COUNT)
            return data
        except BlockingIOError:
            return b""
        except (OSError, ValueError, termios.error) as error:
            raise self._gone(error) from error

    def wait(self, seconds: float) -> None:
        """Sleep until something has come, for at most so long."""
        try:
            select.select([self._fd], [], [], seconds)
        except (OSError, ValueError) as error:
            raise self._gone(error) from error

    def close(self) -> None:
        """Close; a port that is gone already is closed without complaint."""
        if self._fd < 0:
            return
        try:
            self._exclusive(False)
            self._fd = -1  # the number may soon be another file's
            self._serial.close()
        except (OSError, termios.error):
            self._fd = -1  # it was gone: nothing is left to give back
            self._serial.is_open = False

    def _wait_writable(self, seconds: float) -> None:
        """Wait until the adapter takes more. Raises BackendError, and forgets what it did not send, when it does not:
        goals that were held up must not be sent in a burst later."""
        if seconds > 0 and select.select([], [self._fd], [], seconds)[1]:
            return
        try:
            termios.tcflush(self._fd, termios.TCOFLUSH)
        except (OSError, termios.error) as error:
            raise self._gone(error) from error
        raise BackendError(
            f"{self.name}: the adapter takes no more bytes: unplug it and plug it in again (is its other end powered?)"
        )

    def _ask_low_latency(self) -> None:
        # A pty or a driver may be without it: slower by its latency timer, which `doctor` reports.
        with suppress(OSError, ValueError, NotImplementedError, AttributeError, termios.error):
            self._serial.set_low_latency_mode(True)

    def _exclusive(self, on: bool) -> None:
        """Keep programs out that ask for no lock. Not on a pty: its far end keeps the mark if this process dies."""
        if os.path.realpath(self.name).startswith("/dev/pts/"):
            return
        fcntl.ioctl(self._fd, termios.TIOCEXCL if on else termios.TIOCNXCL)

    def _gone(self, error: Exception) -> BackendError:
        return BackendError(f"{self.name}: the port is gone ({error}): check the USB cable and the adapter")


def drain(port: Port, clock: Clock, quiet_ns: int, limit_ns: int) -> tuple[int, bool]:
    """Read and drop until the line was silent for `quiet_ns`, for at most `limit_ns`.

    Returns the bytes dropped and whether it fell silent.
    """
    began = last = clock.now_ns()
    dropped = 0
    while True:
        now = clock.now_ns()
        if data := port.read():
            dropped, last = dropped + len(data), now
        if now - last >= quiet_ns:
            return dropped, True
        if now - began >= limit_ns:
            return dropped, False
        clock.sleep_until(now + min(_POLL_NS, quiet_ns))


def _cannot_open(name: str, baud: int, error: Exception) -> str:
    if isinstance(error, ValueError):
        return f"{name}: cannot be set to {baud} bit/s: {error}"
    if not os.path.exists(name):
        return f"{name}: no such port: plug the adapter in, or name another with --port"
    if not os.access(name, os.R_OK | os.W_OK):
        return f"{name}: no permission: add yourself to the group that owns it (usually dialout) and log in again"
    if getattr(error, "errno", None) in (11, 16) or "lock" in str(error).lower():
        return f"{name}: another program has the port: end it first (`sudo fuser -v {name}` names it)"
    if "Inappropriate ioctl" in str(error):
        return f"{name}: is no serial port: servoid bringup find-port lists them"
    return f"{name}: cannot be opened: {error}"

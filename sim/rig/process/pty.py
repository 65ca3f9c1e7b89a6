"""The serial port of a virtual rig: a pseudo-terminal, as a program on its other side sees an adapter."""

from __future__ import annotations

import fcntl
import os
import select
import struct
import termios
import time
import tty
from pathlib import Path

_TCGETS2 = 0x802C542A  # Linux: terminal settings with the speed as a number, whatever it is
_TERMIOS2 = struct.Struct("4IB19B2I")
_FORGOTTEN = 65536  # bytes that wait for a host that does not read, before the oldest are lost
_VISIBLE_SECONDS = 0.05
_KERNEL_BUFFER = 4095  # bytes that a terminal holds for its reader


class Pty:
    """A pty, with a symbolic link to it where one is asked for. Raises OSError where it cannot be made.

    A link that is there is another program's, unless it points to nothing, or a rig `left` it that was killed: the pty
    that it points to may be somebody's terminal by now.
    """

    def __init__(self, link: Path | None = None, left: bool = False) -> None:
        self._link = link
        if link is not None and link.is_symlink() and (left or not link.exists()):
            link.unlink()
        self._backlog = bytearray()
        self.master = self.slave = -1
        self.open()

    def open(self) -> None:
        """Plug the adapter in."""
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        os.set_blocking(self.master, False)
        self.name = os.ttyname(self.slave)
        if self._link is not None:
            try:
                self._link.symlink_to(self.name)
            except FileExistsError:
                raise FileExistsError(f"{self._link} is there already, and no virtual rig made it") from None

    @property
    def port(self) -> str:
        """What a person gives as the port."""
        return str(self._link or self.name)

    @property
    def is_open(self) -> bool:
        return self.master >= 0

    @property
    def baud(self) -> int:
        """The speed that the host has set [bit/s]."""
        settings = fcntl.ioctl(self.slave, _TCGETS2, bytes(_TERMIOS2.size))
        return int(_TERMIOS2.unpack(settings)[-1])

    def stall(self, stalled: bool) -> None:
        """Take nothing more from the host: its writes block."""
        termios.tcflow(self.slave, termios.TCOOFF if stalled else termios.TCOON)

    def read(self) -> bytes:
        """Everything that the host has written by now."""
        data = bytearray()
        while True:
            try:
                piece = os.read(self.master, 65536)
            except BlockingIOError:
                return bytes(data)
            data += piece

    def flush(self) -> None:
        """Forget what either side has not read yet."""
        self._backlog.clear()
        self.read()
        termios.tcflush(self.slave, termios.TCIFLUSH)

    def write(self, data: bytes, *, visible: bool = False) -> None:
        """Hand bytes to the host. With `visible`, return only when it can read them."""
        self._backlog += data
        del self._backlog[:-_FORGOTTEN]
        if not self._backlog:
            return
        before = self._waiting() if visible else 0
        try:
            sent = os.write(self.master, self._backlog)
        except BlockingIOError:
            return
        del self._backlog[:sent]
        deadline = time.monotonic() + _VISIBLE_SECONDS
        while visible and self._waiting() < min(before + sent, _KERNEL_BUFFER) and time.monotonic() < deadline:
            select.select([self.slave], [], [], 0)  # the kernel moves the bytes over at the latest when asked
            time.sleep(0)

    def _waiting(self) -> int:
        (count,) = struct.unpack("i", fcntl.ioctl(self.slave, termios.FIONREAD, b"\0\0\0\0"))
        return int(count)

    def close(self) -> None:
        """Pull the adapter out."""
        if self.is_open:
            os.close(self.master)
            os.close(self.slave)
            self.master = self.slave = -1
            self._backlog.clear()
        if self._link is not None and self._link.is_symlink() and os.readlink(self._link) == self.name:
            self._link.unlink()

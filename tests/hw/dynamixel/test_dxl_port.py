"""The serial port on a pty: what it does when the other side stops reading, goes away, or is somebody else's."""

from __future__ import annotations

import contextlib
import os
import pty
import tty
from collections.abc import Iterator

import pytest
from waiting import type_in, until

from servoid.hw.contracts.body import BackendError
from servoid.hw.dynamixel.transport.port import SerialPort, drain


@pytest.fixture
def line() -> Iterator[tuple[int, str]]:
    """The far end of a pty, and the name of the near one."""
    far, near = pty.openpty()
    tty.setraw(near)
    name = os.ttyname(near)
    os.close(near)
    yield far, name
    with contextlib.suppress(OSError):  # a test may close it itself
        os.close(far)


def test_bytes_go_both_ways_and_reading_does_not_wait(line: tuple[int, str]) -> None:
    far, name = line
    port = SerialPort(name, 2_000_000)
    assert port.read() == b""
    port.write(b"\xff\xff\xfd\x00\x11\x13")  # with XON and XOFF, which a cooked line would eat
    assert os.read(far, 100) == b"\xff\xff\xfd\x00\x11\x13"
    type_in(far, port.fileno(), b"\x03\x0d\x00")
    assert port.read() == b"\x03\x0d\x00"
    port.set_baud(4_000_000)
    assert port.baud == 4_000_000
    port.close()
    port.close()


def test_a_port_is_one_owners(line: tuple[int, str]) -> None:
    _, name = line
    port = SerialPort(name, 1_000_000)
    with pytest.raises(BackendError, match="another program has the port"):
        SerialPort(name, 1_000_000)
    port.close()
    SerialPort(name, 1_000_000).close()


def test_an_adapter_that_stops_draining_does_not_block(line: tuple[int, str]) -> None:
    far, name = line
    port = SerialPort(name, 2_000_000)
    with pytest.raises(BackendError, match="takes no more bytes"):
        port.write(bytes(1_000_000))
    port.write(b"now")
    held = b""
    while not held.endswith(b"now"):
        held += os.read(far, 65536)
    assert len(held) < 500_000, "what was held up is mostly forgotten, and the port works again"
    port.close()


def test_a_port_that_vanishes_is_a_backend_error(line: tuple[int, str]) -> None:
    far, name = line
    port = SerialPort(name, 2_000_000)
    os.close(far)
    with pytest.raises(BackendError, match="port is gone"):
        until(port.read, "it reads on")
    with pytest.raises(BackendError, match="port is gone"):
        port.write(b"x")
    port.close()
    with pytest.raises(BackendError, match="port is gone"):
        port.read()


def test_a_port_that_is_not_there_says_what_to_do(tmp_path: object) -> None:
    with pytest.raises(BackendError, match="no such port: plug"):
        SerialPort(f"{tmp_path}/ttyUSB9", 1_000_000)


class Babble:
    """A port on which bytes come until `until`, by a clock that only sleeping advances."""

    name, baud = "babble", 1_000_000

    def __init__(self, until: int) -> None:
        self.time, self.until = 0, until

    def read(self) -> bytes:
        return b"\xff" if self.time < self.until else b""

    def write(self, data: bytes) -> None: ...

    def set_baud(self, baud: int) -> None: ...

    def close(self) -> None: ...

    def now_ns(self) -> int:
        return self.time

    def sleep_until(self, time_ns: int) -> None:
        self.time = max(self.time, time_ns)


def test_draining_ends_with_silence_or_at_its_limit() -> None:
    port = Babble(until=1_000_000)
    dropped, silent = drain(port, port, quiet_ns=300_000, limit_ns=5_000_000)
    assert silent
    assert dropped == 20
    assert 1_250_000 <= port.time <= 1_400_000
    port = Babble(until=10**12)
    assert drain(port, port, quiet_ns=300_000, limit_ns=5_000_000)[1] is False
    assert port.time <= 5_100_000

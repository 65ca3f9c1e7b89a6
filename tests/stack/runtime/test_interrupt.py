"""Signals as requests: each that ends or freezes a process is one, and a closed terminal is not two."""

from __future__ import annotations

import signal
import subprocess
import sys

import pytest

from servoid.stack.runtime.interrupt import ALWAYS, ELSE, IGNORED, Interrupt

# Of a program that has gone wrong, of children and windows, or that nothing can handle; Python ignores PIPE and XFSZ.
OTHERS = {
    *(signal.SIGKILL, signal.SIGSTOP, signal.SIGCONT, signal.SIGCHLD, signal.SIGWINCH, signal.SIGURG),
    *(signal.SIGILL, signal.SIGTRAP, signal.SIGABRT, signal.SIGBUS, signal.SIGFPE, signal.SIGSEGV, signal.SIGSYS),
    *(signal.SIGPIPE, signal.SIGXFSZ),
}


def test_every_signal_is_a_request_or_known_to_be_none() -> None:
    """SIGHUP was forgotten: a lost ssh connection dropped a walking robot."""
    named = {number for number in signal.valid_signals() if isinstance(number, signal.Signals)}
    ordinary = {number for number in named if number < signal.SIGRTMIN} - {getattr(signal, "SIGSTKFLT", 16)}
    assert ordinary - OTHERS == {*ALWAYS, *ELSE, *IGNORED}


@pytest.mark.parametrize("number", [*ALWAYS, *ELSE])
def test_a_signal_asks_to_end_and_its_handler_comes_back(number: signal.Signals) -> None:
    before = signal.signal(number, signal.SIG_DFL)
    try:
        with Interrupt() as interrupt:
            signal.raise_signal(number)
            assert interrupt.count == 1
        assert signal.getsignal(number) is signal.SIG_DFL
    finally:
        signal.signal(number, before)


@pytest.mark.parametrize(
    ("sent", "count"),
    [
        ([signal.SIGHUP, signal.SIGHUP], 1),
        ([signal.SIGHUP, signal.SIGTERM, signal.SIGHUP], 1),
        ([signal.SIGTERM, signal.SIGHUP], 1),
        ([signal.SIGHUP, signal.SIGTERM, signal.SIGTERM], 2),
        ([signal.SIGINT, signal.SIGINT], 2),
        ([signal.SIGINT, signal.SIGTERM], 2),
    ],
)
def test_a_hang_up_and_what_comes_with_it_are_one_request(sent: list[signal.Signals], count: int) -> None:
    """The kernel and the shell both send SIGHUP, and a session manager SIGTERM: a second request drops the robot."""
    with Interrupt() as interrupt:
        for number in sent:
            signal.raise_signal(number)
        assert interrupt.count == count


def test_a_program_that_was_told_to_survive_its_terminal_does() -> None:
    before = signal.signal(signal.SIGHUP, signal.SIG_IGN)  # nohup
    try:
        with Interrupt() as interrupt:
            signal.raise_signal(signal.SIGHUP)
            assert interrupt.count == 0
    finally:
        signal.signal(signal.SIGHUP, before)


ON_A_STACK_THAT_IS_GONE = """
import ctypes, mmap, signal
from servoid.stack.runtime.interrupt import Interrupt
class Stack(ctypes.Structure):
    _fields_ = (("start", ctypes.c_void_p), ("flags", ctypes.c_int), ("size", ctypes.c_size_t))
libc = ctypes.CDLL(None)
libc.mmap.restype = ctypes.c_void_p
size = 65536
place = libc.mmap(None, ctypes.c_size_t(size), 3, mmap.MAP_PRIVATE | mmap.MAP_ANONYMOUS, -1, ctypes.c_long(0))
def lost():
    libc.sigaltstack(ctypes.byref(Stack(place, 0, size)), None)
lost()
libc.munmap(ctypes.c_void_p(place), ctypes.c_size_t(size))
with Interrupt() as interrupt:
    signal.raise_signal(signal.SIGINT)
    lost()
    try:
        interrupt.settle()
    except KeyboardInterrupt:
        signal.raise_signal(signal.SIGINT)
    print(interrupt.count)
"""


def test_a_signal_is_counted_though_a_library_took_away_the_stack_that_it_gave_for_signals() -> None:
    """Exporting a network leaves one behind that is unmapped: Ctrl-C ended the program by a segmentation fault."""
    result = subprocess.run([sys.executable, "-c", ON_A_STACK_THAT_IS_GONE], capture_output=True, text=True)
    assert (result.stdout, result.stderr, result.returncode) == ("2\n", "", 0)

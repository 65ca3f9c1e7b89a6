"""Ctrl-C at a program's start and end: never lost in a library that is being imported, never a traceback."""

from __future__ import annotations

import ctypes
import signal
import sys
import threading
from collections.abc import Iterator
from contextlib import contextmanager
from multiprocessing import resource_tracker
from types import FrameType

_AGAIN_SECONDS = 0.02
_DISABLE = 2  # SS_DISABLE of sigaltstack(2)


class _Stack(ctypes.Structure):
    """stack_t of sigaltstack(2)."""

    _fields_ = (("start", ctypes.c_void_p), ("flags", ctypes.c_int), ("size", ctypes.c_size_t))


def ordinary_stack() -> None:
    """Have this thread's signals handled on its ordinary stack.

    Python asks for another one where the thread has it. Libraries that export and run networks give the thread one and
    free it again: then the first Ctrl-C ends the program by a segmentation fault, torque on.
    """
    if sys.platform == "linux":
        ctypes.CDLL(None).sigaltstack(ctypes.byref(_Stack(None, _DISABLE, 0)), None)


def raise_interrupts() -> None:
    """Let Ctrl-C raise KeyboardInterrupt as Python does, but once the import that it falls into is through.

    A compiled module makes an ImportError of it, and what is half imported may swallow it. So may a destructor, whose
    exceptions Python does no more than print.
    """
    signal.signal(signal.SIGINT, _raise)
    sys.unraisablehook = _unraisable


def ignore_interrupts() -> None:
    """The program is over and says its last: another Ctrl-C would be a traceback. After `raise_interrupts` alone."""
    if signal.getsignal(signal.SIGINT) is _raise:
        signal.signal(signal.SIGINT, signal.SIG_IGN)


def importing(frame: FrameType | None) -> bool:
    """Whether a module is being imported where a signal arrived."""
    while frame is not None:
        if frame.f_code.co_filename.startswith("<frozen importlib"):
            return True
        frame = frame.f_back
    return False


@contextmanager
def held_back(*numbers: signal.Signals) -> Iterator[None]:
    """Processes that are started meanwhile never get these signals, from their first instruction on; in this process
    they wait until the end. A terminal sends Ctrl-C to all of a program's processes, and one that is still starting
    would answer with a traceback."""
    resource_tracker.ensure_running()  # multiprocessing starts it with the first process, and lets SIGINT in again then
    before = signal.pthread_sigmask(signal.SIG_BLOCK, numbers)
    try:
        yield
    finally:
        signal.pthread_sigmask(signal.SIG_SETMASK, before)


def _raise(number: int, frame: FrameType | None) -> None:
    if importing(frame):
        _again()
    else:
        raise KeyboardInterrupt


def _unraisable(lost: sys.UnraisableHookArgs) -> None:
    if issubclass(lost.exc_type, KeyboardInterrupt):
        _again()
    else:
        sys.__unraisablehook__(lost)


def _again() -> None:
    """As if Ctrl-C were pressed a little later: a signal of the system, which ends what the program waits for, too."""
    timer = threading.Timer(_AGAIN_SECONDS, signal.pthread_kill, (threading.main_thread().ident, signal.SIGINT))
    timer.daemon = True
    timer.start()

"""What the operating system can do for a loop that must not be late."""

from __future__ import annotations

import gc
import os
from collections.abc import Callable, Iterator
from contextlib import contextmanager

from servoid.hw.clock import wake_sharply

PRIORITY = 50  # of SCHED_FIFO: above ordinary processes, below the kernel's own threads


@contextmanager
def undisturbed(first_in_line: bool, note: Callable[[str], None]) -> Iterator[None]:
    """Keep garbage collection, and with `first_in_line` other processes, from holding up the thread that enters.

    Objects that live already are frozen, so that a full collection (65 to 103 ms with torch imported) does not visit
    them. SCHED_FIFO needs a right that a user may lack: then `note` is told, and the run goes on.
    """
    gc.collect()
    gc.freeze()
    wake_sharply()
    before: tuple[int, os.sched_param] | None = None
    if first_in_line:
        policy, parameter = os.sched_getscheduler(0), os.sched_getparam(0)
        try:
            os.sched_setscheduler(0, os.SCHED_FIFO, os.sched_param(PRIORITY))
            before = policy, parameter
        except PermissionError:
            note("no right to SCHED_FIFO, so other processes may delay ticks: add an rtprio limit for this user")
    try:
        yield
    finally:
        if before is not None:
            os.sched_setscheduler(0, *before)
        gc.unfreeze()

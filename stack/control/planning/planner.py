"""Planners answer plan requests beside the loop: in line for simulation, in a process of their own in real time.

A plan depends on its request alone, so a run does not depend on which one answered, as long as none is late.
"""

from __future__ import annotations

import contextlib
import gc
import multiprocessing
import os
import signal
import traceback
from collections.abc import Callable
from multiprocessing.connection import Connection
from multiprocessing.context import SpawnContext
from multiprocessing.process import BaseProcess
from multiprocessing.util import Finalize
from typing import Protocol

from servoid.hw.contracts.control import Plan, PlanRequest
from servoid.hw.signals import held_back

Answer = Callable[[PlanRequest], Plan]


class PlannerError(Exception):
    """A planner cannot plan any more; the run must end."""


class Planner(Protocol):
    """Answers one request at a time; a new one replaces what was not collected."""

    def reset(self) -> None:
        """Forget all requests."""
        ...

    def submit(self, request: PlanRequest) -> None: ...

    def collect(self, tick: int, wait: bool) -> Plan | None:
        """The plan requested at `tick`, once; None where it is not ready, unless `wait`. Raises PlannerError."""
        ...

    def close(self) -> None: ...


class InlinePlanner:
    """Plans when collected, so a plan is never late: for simulation as fast as possible."""

    def __init__(self, answer: Answer) -> None:
        self._answer = answer
        self._request: PlanRequest | None = None

    def reset(self) -> None:
        self._request = None

    def submit(self, request: PlanRequest) -> None:
        self._request = request

    def collect(self, tick: int, wait: bool) -> Plan | None:
        request = self._request
        if request is None or request.tick != tick:
            return None
        self._request = None
        return self._answer(request)

    def close(self) -> None:
        self._request = None


class ProcessPlanner:
    """Plans in a process of its own, started fresh (spawn), which ends with its parent.

    Neither `submit` nor `collect` without `wait` ever blocks: the process is sent a request only when it is idle. One
    that finds it busy, with a request from before it or from the last episode, waits here.
    """

    def __init__(
        self, build: Callable[[], Answer], start_timeout: float = 120.0, context: SpawnContext | None = None
    ) -> None:
        """Start the process, in a `context` of its own where none is given, and wait until it has called `build`, which
        must be picklable, there.

        Raises PlannerError with the reason when that fails or takes longer than `start_timeout` [s].
        """
        self._serial = 0  # of the newest request
        self._busy = False
        self._waiting: tuple[int, PlanRequest] | None = None
        self._ready: tuple[int, Plan] | None = None
        context = context or multiprocessing.get_context("spawn")
        self._pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, build), name="planner", daemon=True)
        with held_back(signal.SIGINT, signal.SIGTERM):  # to the whole group: the loop still plans while it ends the run
            self._process.start()
        theirs.close()
        # At exit multiprocessing waits for its processes: without this, for ever for one that nobody closed.
        self._end = Finalize(self, _end, (self._pipe, self._process), exitpriority=0)
        try:
            if not self._pipe.poll(start_timeout):
                raise PlannerError(
                    f"the planner process was not ready within {start_timeout:g} s; is the machine busy?"
                )
            self._receive()
        except BaseException:
            self.close()
            raise

    def reset(self) -> None:
        self._serial += 1  # what is still being planned is not wanted any more
        self._waiting = self._ready = None

    def submit(self, request: PlanRequest) -> None:
        self._serial += 1
        self._ready = None
        self._waiting = (self._serial, request)
        self._pump(0.0)

    def collect(self, tick: int, wait: bool) -> Plan | None:
        self._pump(0.0)
        while wait and (self._busy or self._waiting is not None):
            self._pump(None)
        if self._ready is None or self._ready[1].tick != tick:
            return None
        plan, self._ready = self._ready[1], None
        return plan

    def close(self) -> None:
        """End the process. May be called twice."""
        self._end()
        self._waiting = self._ready = None

    def _pump(self, timeout: float | None) -> None:
        """Take in an answer, waiting up to `timeout` [s] (None: as long as it takes), and send what waits."""
        if self._busy and self._pipe.poll(timeout):
            self._busy = False
            answer = self._receive()
            if answer is not None and answer[0] == self._serial:
                self._ready = answer
        if not self._busy and self._waiting is not None:
            try:
                self._pipe.send(self._waiting)
            except OSError as error:
                raise PlannerError(self._obituary()) from error
            self._waiting = None
            self._busy = True

    def _receive(self) -> tuple[int, Plan] | None:
        """An answer; None for the process's first message. Raises PlannerError."""
        try:
            message = self._pipe.recv()
        except (EOFError, OSError) as error:
            raise PlannerError(self._obituary()) from error
        if isinstance(message, str):
            raise PlannerError(f"the planner process failed:\n{message}")
        answer: tuple[int, Plan] | None = message
        return answer

    def _obituary(self) -> str:
        self._process.join(1.0)
        code = self._process.exitcode
        how = f"was killed by signal {-code}" if code is not None and code < 0 else f"ended with code {code}"
        return f"the planner process {how}; it cannot plan any more"


def _end(pipe: Connection, process: BaseProcess) -> None:
    pipe.close()
    process.join(0.2)
    if process.is_alive():  # in the middle of a plan
        process.kill()
        process.join()


def _serve(pipe: Connection, build: Callable[[], Answer]) -> None:
    """The planner process: answer requests until the other end of the pipe is gone."""
    os.environ["OMP_NUM_THREADS"] = "1"  # before torch is imported
    try:
        answer = build()
        gc.collect()
        gc.freeze()  # a full collection with torch imported takes longer than a plan
        pipe.send(None)
        while True:
            serial, request = pipe.recv()
            pipe.send((serial, answer(request)))
    except (EOFError, BrokenPipeError, ConnectionResetError):
        return  # the parent closed the pipe, or died
    except Exception:
        reason = traceback.format_exc()
        with contextlib.suppress(OSError):  # nobody is left to be told
            pipe.send(reason)

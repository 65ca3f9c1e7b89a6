"""Work on several processes: jobs go out one by one, answers come back as they are ready.

Workers are processes of this machine, or of others: `Place` says where they come from. What is done with jobs, answers
and losses is the same.
"""

from __future__ import annotations

import math
import os
import signal
import time
import traceback
from collections import deque
from collections.abc import Callable, Iterable, Iterator, Sequence
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any, Literal, Protocol, TypeVar

from servoid.hw.signals import held_back

Job = TypeVar("Job")
Answer = TypeVar("Answer")

_TRIES = 3  # workers that a job is given to, one after the other, when their machines are lost
_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class MachineLost(Exception):
    """The machine of a worker is gone, and the job with it: another worker may do it."""


class JobWorker(Protocol):
    """A process that does one job after the other."""

    def give(self, job: Any) -> None:
        """Send a job; a worker that cannot take it says so in `answer`."""

    def answer(self) -> Any:
        """Wait for the answer. Raises what the work raised, RuntimeError when the process died, or MachineLost."""

    def kill(self) -> None:
        """End the process, whatever it does."""


Hired = TypeVar("Hired", bound=JobWorker)


class Place(Protocol[Hired]):
    """Where workers are."""

    @property
    def here(self) -> bool:
        """Whether it is this machine: then a single worker needs no process of its own."""

    @property
    def size(self) -> int:
        """How many workers it has cores for."""

    def hire(self, work: Callable[[Any], Any], needed: bool) -> Hired | None:
        """A new worker that does `work`, which must be picklable; None where there is no room.

        `needed` says that there is no other: then it waits for room, and raises RuntimeError where none comes.
        """

    def ready(self, busy: Sequence[Hired], seconds: float | None) -> Sequence[Hired]:
        """Those that have an answer, after at most so long; waits for the first one where `seconds` is None."""


class Worker:
    """A process of this machine. `pipe` is ready when there is an answer."""

    def __init__(self, work: Callable[[Any], Any]) -> None:
        """`work` must be picklable."""
        import multiprocessing as mp

        context = mp.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, work), daemon=True)
        with _one_thread(), held_back(signal.SIGINT):
            self._process.start()
        theirs.close()

    def give(self, job: Any) -> None:
        """Send a job. To a process that has died meanwhile it is not: `answer` says so."""
        with suppress(OSError):
            self.pipe.send(job)

    def answer(self) -> Any:
        """Wait for the answer. Raises what the work raised, and RuntimeError when the process died."""
        try:
            done, answer = self.pipe.recv()
        except (EOFError, OSError):
            self._process.join(1.0)
            raise RuntimeError(
                f"a worker process died (exit code {self._process.exitcode}); is there enough memory? try fewer with"
                " --workers"
            ) from None
        if not done:
            raise answer
        return answer

    def kill(self) -> None:
        """End the process, whatever it does."""
        self._process.kill()  # a run takes a polite signal for a request to lower the robot first, and goes on
        self._process.join()
        self.pipe.close()


class Processes:
    """Workers that are processes of this machine."""

    here = True

    @property
    def size(self) -> int:
        return os.cpu_count() or 1

    def hire(self, work: Callable[[Any], Any], needed: bool) -> Worker:
        return Worker(work)

    def ready(self, busy: Sequence[Worker], seconds: float | None) -> Sequence[Worker]:
        from multiprocessing.connection import wait

        workers: dict[Any, Worker] = {worker.pipe: worker for worker in busy}
        return [workers[pipe] for pipe in wait(list(workers), seconds)]


@dataclass(frozen=True)
class Lost:
    """A job without an answer, and why."""

    how: Literal["hung", "died"]
    text: str
    error: Exception = field(compare=False)


@dataclass(eq=False)
class _Given:
    """A job that a worker has: when it counts as hung, and how many workers were lost with it before."""

    job: Any
    hangs: float
    losses: int


def each(
    work: Callable[[Job], Answer],
    jobs: Iterable[Job],
    workers: int,
    deadline: float | None = None,
    place: Place[Any] = Processes(),  # noqa: B008 (it has no state)
) -> Iterator[Answer]:
    """`work(job)` of each job on `workers` processes, as they come: those that are quicker come first.

    `work` must be picklable. A job is asked for when a process is free for it, so jobs may depend on the answers. At
    `deadline`, by `time.monotonic`, what still runs is given up; with one worker of this machine, where everything is
    done in this process, a job that runs is finished. Workers are at `place`, by default processes of this machine. A
    job whose machine is lost is given to another worker, and each is answered once. Raises what `work` raises, and
    RuntimeError when a process dies.
    """
    if workers > 1 or not place.here:
        until = math.inf if deadline is None else deadline
        for _, answer in _spread(work, iter(jobs), workers, until, place=place):
            if isinstance(answer, Lost):
                raise answer.error
            yield answer
        return
    for job in jobs:
        if deadline is not None and time.monotonic() >= deadline:
            return
        yield work(job)


def each_or_lost(
    work: Callable[[Job], Answer], jobs: Iterable[Job], workers: int, seconds: float, start_seconds: float = 60.0
) -> Iterator[tuple[Job, Answer | Lost]]:
    """Every job with its answer, as they come, for jobs that may hang or kill their process: never in this one.

    Lost is the answer of one that did not end within `seconds`, that raised, or whose process died; the others are
    done. `work` must be picklable. A process's first job may take `start_seconds` more.
    """
    return _spread(work, iter(jobs), workers, patience=(seconds, start_seconds), place=Processes())


def _spread(
    work: Callable[[Job], Answer],
    jobs: Iterator[Job],
    workers: int,
    deadline: float = math.inf,
    *,
    patience: tuple[float, float] = (math.inf, 0.0),
    place: Place[Any],
) -> Iterator[tuple[Job, Answer | Lost]]:
    """`deadline` is that of all; `patience` are the seconds that each job may take, and those that a process's first
    one may take besides."""
    seconds, start_seconds = patience
    idle: list[JobWorker] = []
    busy: dict[JobWorker, _Given] = {}
    again: deque[tuple[Job, int]] = deque()  # lost with their machines, and how often
    try:
        while True:
            while len(busy) < workers and time.monotonic() < deadline:
                try:
                    job, losses = again.popleft() if again else (next(jobs), 0)
                except StopIteration:
                    break
                longest = seconds if idle else seconds + start_seconds
                worker = idle.pop() if idle else place.hire(work, needed=not busy)
                if worker is None:
                    again.appendleft((job, losses))
                    break
                busy[worker] = _Given(job, time.monotonic() + longest, losses)
                worker.give(job)
            if not busy:
                return
            until = min(deadline, *(given.hangs for given in busy.values()))
            ready = place.ready(list(busy), None if until == math.inf else max(until - time.monotonic(), 0.0))
            if not ready and time.monotonic() >= deadline:
                return
            for worker, given in list(busy.items()):
                if worker in ready:
                    answer = _answer(worker)
                elif time.monotonic() >= given.hangs:
                    text = f"did not end within {seconds:g} s"
                    answer = Lost("hung", text, TimeoutError(text))
                else:
                    continue
                del busy[worker]
                if isinstance(answer, Lost):
                    worker.kill()  # and another takes its place: what it holds may be half changed
                    if isinstance(answer.error, MachineLost) and given.losses + 1 < _TRIES:
                        again.append((given.job, given.losses + 1))
                        continue
                else:
                    idle.append(worker)
                yield given.job, answer
    finally:
        for worker in (*idle, *busy):
            worker.kill()


def _answer(worker: JobWorker) -> Any:
    try:
        return worker.answer()
    except Exception as error:
        return Lost("died", f"{type(error).__name__}: {error}", error)


def attempt(work: Callable[[Any], Any], job: Any) -> tuple[bool, Any]:
    """Whether the job could be done, and its answer, or what was raised instead."""
    try:
        return True, work(job)
    except Exception as error:
        if os.environ.get("SERVOID_DEBUG") == "1":
            error.add_note(traceback.format_exc())
        return False, error


def _serve(pipe: Connection, work: Callable[[Any], Any]) -> None:
    """The process of a worker: answer until the other end is gone. Ctrl-C is the parent's."""
    while True:
        try:
            job = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            message = attempt(work, job)
        except KeyboardInterrupt:  # told to a run in this process: the parent was told too
            return
        pipe.send(message)


@contextmanager
def _one_thread() -> Iterator[None]:
    """Processes that are started meanwhile calculate on one thread each: the workers are the parallelism. Libraries
    look when they are loaded, and those that `work` imports are, before the first line of the process is ours."""
    before = {name: os.environ.get(name) for name in _THREADS}
    os.environ.update(dict.fromkeys(_THREADS, "1"))
    try:
        yield
    finally:
        for name, value in before.items():
            if value is None:
                del os.environ[name]
            else:
                os.environ[name] = value

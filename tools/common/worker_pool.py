"""Work on several processes: jobs go out one by one, answers come back as they are ready."""

from __future__ import annotations

import math
import os
import signal
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager, suppress
from dataclasses import dataclass, field
from multiprocessing.connection import Connection
from typing import Any, Literal, TypeVar

from servoid.hw.signals import held_back

Job = TypeVar("Job")
Answer = TypeVar("Answer")

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Worker:
    """A process that does one job after the other. `pipe` is ready when there is an answer."""

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


@dataclass(frozen=True)
class Lost:
    """A job without an answer, and why."""

    how: Literal["hung", "died"]
    text: str
    error: Exception = field(compare=False)


def each(
    work: Callable[[Job], Answer], jobs: Iterable[Job], workers: int, deadline: float | None = None
) -> Iterator[Answer]:
    """`work(job)` of each job on `workers` processes, as they come: those that are quicker come first.

    `work` must be picklable. A job is asked for when a process is free for it, so jobs may depend on the answers. At
    `deadline`, by `time.monotonic`, what still runs is given up; with one worker, where everything is done in this
    process, a job that runs is finished. Raises what `work` raises, and RuntimeError when a process dies.
    """
    if workers > 1:
        for _, answer in _spread(work, iter(jobs), workers, math.inf if deadline is None else deadline):
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
    return _spread(work, iter(jobs), workers, seconds=seconds, start_seconds=start_seconds)


def _spread(
    work: Callable[[Job], Answer],
    jobs: Iterator[Job],
    workers: int,
    deadline: float = math.inf,
    seconds: float = math.inf,
    start_seconds: float = 0.0,
) -> Iterator[tuple[Job, Answer | Lost]]:
    """`deadline` is that of all, `seconds` are for each job."""
    from multiprocessing.connection import wait

    idle: list[Worker] = []
    busy: dict[Connection, tuple[Worker, Job, float]] = {}  # by their pipes: the job, and when it hangs
    try:
        while True:
            while len(busy) < workers and time.monotonic() < deadline:
                try:
                    job = next(jobs)
                except StopIteration:
                    break
                worker, patience = (idle.pop(), seconds) if idle else (Worker(work), seconds + start_seconds)
                busy[worker.pipe] = worker, job, time.monotonic() + patience
                worker.give(job)
            if not busy:
                return
            until = min(deadline, *(hangs for _, _, hangs in busy.values()))
            ready = wait(list(busy), None if until == math.inf else max(until - time.monotonic(), 0.0))
            if not ready and time.monotonic() >= deadline:
                return
            for pipe, (worker, job, hangs) in list(busy.items()):
                if pipe in ready:
                    answer = _answer(worker)
                elif time.monotonic() >= hangs:
                    text = f"did not end within {seconds:g} s"
                    answer = Lost("hung", text, TimeoutError(text))
                else:
                    continue
                del busy[pipe]
                if isinstance(answer, Lost):
                    worker.kill()  # and another takes its place: what it holds may be half changed
                else:
                    idle.append(worker)
                yield job, answer
    finally:
        for worker in (*idle, *(worker for worker, _, _ in busy.values())):
            worker.kill()


def _answer(worker: Worker) -> Any:
    try:
        return worker.answer()
    except Exception as error:
        return Lost("died", f"{type(error).__name__}: {error}", error)


def _serve(pipe: Connection, work: Callable[[Any], Any]) -> None:
    """The process of a worker: answer until the other end is gone. Ctrl-C is the parent's."""
    while True:
        try:
            job = pipe.recv()
        except (EOFError, OSError):
            return
        try:
            message: tuple[bool, Any] = (True, work(job))
        except KeyboardInterrupt:  # told to a run in this process: the parent was told too
            return
        except Exception as error:
            if os.environ.get("SERVOID_DEBUG") == "1":
                error.add_note(traceback.format_exc())
            message = (False, error)
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

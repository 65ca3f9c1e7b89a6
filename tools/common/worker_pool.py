"""Work on several processes: jobs go out one by one, answers come back as they are ready."""

from __future__ import annotations

import os
import signal
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from contextlib import contextmanager
from multiprocessing.connection import Connection
from typing import Any, TypeVar

Job = TypeVar("Job")
Answer = TypeVar("Answer")

_THREADS = ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS")


class Worker:
    """A process that does one job after the other. What is sent on `pipe` is a job, and then there is an answer."""

    def __init__(self, work: Callable[[Any], Any]) -> None:
        """`work` must be picklable."""
        import multiprocessing as mp

        context = mp.get_context("spawn")
        self.pipe, theirs = context.Pipe()
        self._process = context.Process(target=_serve, args=(theirs, work), daemon=True)
        with _one_thread():
            self._process.start()
        theirs.close()

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


def each(
    work: Callable[[Job], Answer], jobs: Iterable[Job], workers: int, deadline: float | None = None
) -> Iterator[Answer]:
    """`work(job)` of each job on `workers` processes, as they come: those that are quicker come first.

    `work` must be picklable. A job is asked for when a process is free for it, so jobs may depend on the answers. At
    `deadline`, by `time.monotonic`, what still runs is given up; with one worker, where everything is done in this
    process, a job that runs is finished. Raises what `work` raises, and RuntimeError when a process dies.
    """
    if workers > 1:
        yield from _spread(work, iter(jobs), workers, deadline)
        return
    for job in jobs:
        if deadline is not None and time.monotonic() >= deadline:
            return
        yield work(job)


def _spread(
    work: Callable[[Job], Answer], jobs: Iterator[Job], workers: int, deadline: float | None
) -> Iterator[Answer]:
    from multiprocessing.connection import wait

    free: list[Worker] = []
    busy: dict[Any, Worker] = {}  # by their pipes
    try:
        while True:
            while len(busy) < workers:
                try:
                    job = next(jobs)
                except StopIteration:
                    break
                worker = free.pop() if free else Worker(work)
                busy[worker.pipe] = worker
                worker.pipe.send(job)
            if not busy:
                return
            ready = wait(list(busy), None if deadline is None else max(deadline - time.monotonic(), 0.0))
            if not ready:
                return
            for pipe in ready:
                answer = busy[pipe].answer()
                free.append(busy.pop(pipe))
                yield answer
    finally:
        for worker in (*free, *busy.values()):
            worker.kill()


def _serve(pipe: Connection, work: Callable[[Any], Any]) -> None:
    """The process of a worker: answer until the other end is gone. Ctrl-C is the parent's."""
    signal.signal(signal.SIGINT, signal.SIG_IGN)
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

"""Work on several processes: jobs go out one by one, answers come back as they are ready."""

from __future__ import annotations

import os
import signal
import time
import traceback
from collections.abc import Callable, Iterable, Iterator
from multiprocessing.connection import Connection
from typing import Any, TypeVar

Job = TypeVar("Job")
Answer = TypeVar("Answer")


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
    import multiprocessing as mp
    from multiprocessing.connection import wait

    context = mp.get_context("spawn")
    processes: list[Any] = []
    busy: list[Connection] = []
    free: list[Connection] = []
    try:
        while True:
            while len(busy) < workers:
                try:
                    job = next(jobs)
                except StopIteration:
                    break
                if not free:
                    ours, theirs = context.Pipe()
                    processes.append(context.Process(target=_serve, args=(theirs, work), daemon=True))
                    processes[-1].start()
                    theirs.close()
                    free.append(ours)
                busy.append(free.pop())
                busy[-1].send(job)
            if not busy:
                return
            ready = wait(busy, None if deadline is None else max(deadline - time.monotonic(), 0.0))
            if not ready:
                return
            for pipe in ready:
                assert isinstance(pipe, Connection)
                answer = _receive(pipe)
                busy.remove(pipe)
                free.append(pipe)
                yield answer
    finally:
        for process in processes:
            process.kill()  # a run takes a polite signal for a request to lower the robot first, and goes on
            process.join()


def _receive(pipe: Connection) -> Any:
    """An answer. Raises what the work raised."""
    try:
        done, answer = pipe.recv()
    except (EOFError, OSError):
        raise RuntimeError("a worker process died; is there enough memory? try fewer with --workers") from None
    if not done:
        raise answer
    return answer


def _serve(pipe: Connection, work: Callable[[Any], Any]) -> None:
    """A worker: answer until the other end is gone. numpy and torch use one thread: the workers are the parallelism.

    Ctrl-C is the parent's.
    """
    signal.signal(signal.SIGINT, signal.SIG_IGN)
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
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

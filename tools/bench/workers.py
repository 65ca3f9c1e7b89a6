"""Worker processes whose jobs may hang: each job has a deadline, and a worker that misses it is killed and replaced."""

from __future__ import annotations

import multiprocessing as mp
import os
import signal
import time
from collections.abc import Callable, Iterator, Sequence
from multiprocessing.connection import Connection, wait
from typing import Any


class Worker:
    """A process that does one job after the other."""

    def __init__(self, work: Callable[[Any], Any]) -> None:
        context = mp.get_context("spawn")
        self.pipe, far = context.Pipe()
        self.process = context.Process(target=_serve, args=(far, work), daemon=False)
        self.process.start()
        far.close()
        self.number: int | None = None  # of its job
        self.deadline = 0.0
        self.started = False

    def give(self, number: int, job: Any, seconds: float) -> None:
        self.number = number
        self.deadline = time.monotonic() + seconds
        self.started = True
        self.pipe.send(job)

    def close(self, kill: bool = False) -> None:
        """End the process; with `kill`, whatever it does."""
        self.pipe.close()  # which it sees once its job is done
        if kill:
            self.process.kill()
        self.process.join()


def work_all(
    work: Callable[[Any], Any], jobs: Sequence[Any], workers: int, seconds: float, start_seconds: float = 60.0
) -> Iterator[tuple[int, Any | None]]:
    """Do every job and yield its number and result as they come; None for one that did not end within `seconds`, or
    whose process died. `work` is a function of a module. A worker's first job may take `start_seconds` more.
    """
    crew = [Worker(work) for _ in range(min(workers, len(jobs)))]
    queue = list(enumerate(jobs))[::-1]
    try:
        while queue or any(worker.number is not None for worker in crew):
            for worker in crew:
                if worker.number is None and queue:
                    worker.give(*queue.pop(), seconds if worker.started else seconds + start_seconds)
            busy = {worker.pipe: i for i, worker in enumerate(crew) if worker.number is not None}
            ready = set(wait(list(busy), timeout=0.2))
            for pipe, i in busy.items():
                worker = crew[i]
                number, done, result = worker.number, pipe in ready, None
                assert number is not None
                if done:
                    try:
                        result = worker.pipe.recv()
                    except (EOFError, OSError):
                        done = False
                if done:
                    worker.number = None
                elif pipe in ready or time.monotonic() > worker.deadline:
                    worker.close(kill=True)
                    crew[i] = Worker(work)
                else:
                    continue
                yield number, result
    finally:
        for worker in crew:
            worker.close(kill=worker.number is not None)


def _serve(pipe: Connection, work: Callable[[Any], Any]) -> None:
    signal.signal(signal.SIGINT, signal.SIG_IGN)  # Ctrl-C is the parent's
    for name in ("OMP_NUM_THREADS", "OPENBLAS_NUM_THREADS", "MKL_NUM_THREADS"):
        os.environ[name] = "1"
    while True:
        try:
            job = pipe.recv()
        except EOFError:
            return
        pipe.send(work(job))

"""Jobs that may hang, or kill their process: each has a deadline, and what became of it is an answer too."""

from __future__ import annotations

import time
from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from multiprocessing.connection import wait
from typing import Any, Literal

from servoid.tools.common.worker_pool import Worker


@dataclass(frozen=True)
class Lost:
    """A job without a result, and why."""

    how: Literal["hung", "died"]
    text: str


def work_all(
    work: Callable[[Any], Any], jobs: Sequence[Any], workers: int, seconds: float, start_seconds: float = 60.0
) -> Iterator[tuple[int, Any]]:
    """Do every job and yield its number and result as they come: Lost for one that did not end within `seconds`, that
    raised, or whose process died. `work` is a function of a module. A worker's first job may take `start_seconds` more.
    """
    queue = list(enumerate(jobs))[::-1]
    idle: list[Worker] = []
    busy: dict[Any, tuple[Worker, int, float]] = {}  # by their pipes: number and deadline of the job
    try:
        while queue or busy:
            while queue and len(busy) < workers:
                number, job = queue.pop()
                worker, patience = (idle.pop(), seconds) if idle else (Worker(work), seconds + start_seconds)
                busy[worker.pipe] = worker, number, time.monotonic() + patience
                worker.pipe.send(job)
            ready = set(wait(list(busy), timeout=0.2))
            for pipe, (worker, number, deadline) in list(busy.items()):
                if pipe in ready:
                    result = _result(worker)
                elif time.monotonic() > deadline:
                    result = Lost("hung", f"did not end within {seconds:g} s")
                else:
                    continue
                del busy[pipe]
                if isinstance(result, Lost):
                    worker.kill()  # and another takes its place: what it holds may be half changed
                else:
                    idle.append(worker)
                yield number, result
    finally:
        for worker in (*idle, *(worker for worker, _, _ in busy.values())):
            worker.kill()


def _result(worker: Worker) -> Any:
    try:
        return worker.answer()
    except Exception as error:  # of one job: it is counted, and the others are done
        return Lost("died", f"{type(error).__name__}: {error}")

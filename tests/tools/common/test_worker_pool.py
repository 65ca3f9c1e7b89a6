"""Jobs are done on several processes, none is asked for too early, and nothing is left running or waited for."""

from __future__ import annotations

import os
import signal
import time
from collections.abc import Iterator
from pathlib import Path

import pytest

from servoid.hw.config import ConfigError
from servoid.tools.common.worker_pool import Lost, Worker, each, each_or_lost


def pid(job: int) -> int:
    time.sleep(0.2)
    return os.getpid()


def refuse(job: int) -> int:
    raise ConfigError(f"job {job}")


def die(job: int) -> None:
    os.kill(os.getpid(), signal.SIGKILL)


def stubborn(job: int) -> None:
    """What a run does with a polite signal."""
    signal.signal(signal.SIGTERM, lambda *_: None)
    time.sleep(600.0)


def swallow(job: int) -> None:
    raise KeyboardInterrupt


def begun_with(job: int) -> str:
    """The environment that this process was started with."""
    return Path("/proc/self/environ").read_text()


@pytest.mark.slow
def test_every_job_is_answered_on_processes_of_their_own() -> None:
    assert sorted(each(abs, iter([-1, -2, -3, -4, -5]), 2)) == [1, 2, 3, 4, 5]
    assert len(set(each(pid, range(6), 2)) | {os.getpid()}) == 3
    assert set(each(pid, range(2), 1)) == {os.getpid()}


@pytest.mark.slow
def test_at_the_deadline_what_runs_is_given_up_however_stubborn() -> None:
    assert list(each(stubborn, range(3), 2, time.monotonic() + 3.0)) == []
    assert list(each(abs, range(3), 1, time.monotonic())) == []


@pytest.mark.slow
def test_jobs_are_asked_for_when_they_can_be_done() -> None:
    """So that a run which refuses its settings does not do so a hundred times."""
    asked = []

    def jobs() -> Iterator[int]:
        for i in range(20):
            asked.append(i)
            yield i

    answers = each(abs, jobs(), 2)
    next(answers)
    assert len(asked) == 2
    answers.close()  # type: ignore[attr-defined]


@pytest.mark.slow
def test_an_error_comes_back() -> None:
    with pytest.raises(ConfigError, match="job 7"):
        list(each(refuse, [7], 2))


@pytest.mark.slow
@pytest.mark.parametrize("work", [die, swallow])
def test_a_process_that_dies_is_noticed(work: object) -> None:
    with pytest.raises(RuntimeError, match="died"):
        list(each(work, [1], 2))  # type: ignore[arg-type]


@pytest.mark.slow
def test_a_worker_calculates_on_one_thread(monkeypatch: pytest.MonkeyPatch) -> None:
    """From its start: numpy and torch look when they are loaded. This process keeps what it has."""
    monkeypatch.delenv("OPENBLAS_NUM_THREADS", raising=False)
    monkeypatch.setenv("OMP_NUM_THREADS", "7")
    (environment,) = each(begun_with, [1], 2)
    assert {"OMP_NUM_THREADS=1", "OPENBLAS_NUM_THREADS=1"} <= set(environment.split("\0"))
    assert os.environ["OMP_NUM_THREADS"] == "7"
    assert "OPENBLAS_NUM_THREADS" not in os.environ


def nap(seconds: float) -> float:
    time.sleep(seconds)
    return seconds


def fail(job: int) -> int:
    if job == 1:
        os._exit(3)
    if job == 2:
        raise ValueError("no such thing")
    return job


def test_what_hangs_is_counted_and_the_rest_is_done() -> None:
    done = dict(each_or_lost(nap, [0.01, 600.0, 0.02], 1, 2.0))
    assert done == {0.01: 0.01, 600.0: Lost("hung", "did not end within 2 s", TimeoutError()), 0.02: 0.02}


def test_what_dies_says_so_and_does_not_count_as_hung() -> None:
    done = dict(each_or_lost(fail, [0, 1, 2, 3], 1, 60.0))
    assert (done[0], done[3]) == (0, 3)
    crashed, raised = done[1], done[2]
    assert isinstance(crashed, Lost)
    assert isinstance(raised, Lost)
    assert crashed.how == raised.how == "died"
    assert "exit code 3" in crashed.text
    assert raised.text == "ValueError: no such thing"


def test_a_worker_that_died_between_two_jobs_is_noticed() -> None:
    """Memory ran out while it waited, say: the next job must not end in an error of the pipe."""
    worker = Worker(die)
    worker.give(1)
    with pytest.raises(RuntimeError, match="exit code -9"):
        worker.answer()
    worker.give(2)
    with pytest.raises(RuntimeError, match="exit code -9"):
        worker.answer()
    worker.kill()

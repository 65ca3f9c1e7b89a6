"""How a run went, counted while it goes on."""

from __future__ import annotations

from array import array
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import numpy as np

from servoid.hw.contracts.task import Assignment, Criterion, Trace
from servoid.stack.log.format import event_message, plain
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.phases import Phases
from servoid.stack.safety.event import Event
from servoid.stack.safety.guard import Guard
from servoid.stack.safety.phase import Phase

_SUMMARY = (
    "outcome", "success", "seconds", "ticks", "missed", "late_p50_ms", "late_p99_ms", "metrics", "task_began",
)  # fmt: skip


@dataclass(frozen=True)
class Result:
    """How a run went, by what the robot knew. Times s, lateness ms."""

    outcome: str  # succeeded, failed, fell, timed_out, stopped or interrupted
    success: bool
    seconds: float  # spent on the task
    ticks: int  # spent on the task
    missed: int
    late_p50_ms: float
    late_p99_ms: float
    metrics: dict[str, float]
    events: tuple[Event, ...]
    trace: Trace
    log: Path | None
    interrupted: bool = False  # whether it was told to end, be it after its task had ended
    criteria: tuple[Criterion, ...] = ()  # of success; none where the task does not say them
    task_began: float | None = None  # tick 0 of the task by the clock of the events, s since the run began

    def summary(self) -> dict[str, Any]:
        """The result as JSON values, without the trace."""
        values: dict[str, Any] = plain({name: vars(self)[name] for name in _SUMMARY})
        criteria: list[Any] = plain([asdict(criterion) | {"met": criterion.met} for criterion in self.criteria])
        return values | {"criteria": criteria, "events": [event_message(event) for event in self.events]}


class Tally:
    """Counts while a run goes on: a listener."""

    def __init__(self) -> None:
        self.events: list[Event] = []
        self._late = array("q")  # ns; a list of numbers would be five times as large
        self._missed = 0
        self._first_ns: int | None = None  # time of the first tick by the body's clock
        self._began: float | None = None

    def __call__(self, record: TickRecord) -> None:
        now = record.observation.time_ns
        self._first_ns = now if self._first_ns is None else self._first_ns
        if self._began is None and record.proposal.instruction is not None:
            self._began = (now - self._first_ns) * 1e-9
        self.events += record.events
        if record.phase is Phase.RUNNING:
            self._late.append(record.timing.late)
            self._missed += record.timing.missed

    def result(
        self, phases: Phases, guard: Guard, assignment: Assignment, log: Path | None, interrupted: bool
    ) -> Result:
        """How the run went, once it has ended."""
        trace = phases.trace()
        success = bool(phases.ended is not None and assignment.success(trace))
        late = np.array(self._late or [0], dtype=float) * 1e-6
        return Result(
            outcome=_outcome(phases, guard, success),
            success=success,
            seconds=phases.task_ticks * trace.dt,
            ticks=phases.task_ticks,
            missed=self._missed,
            late_p50_ms=float(np.percentile(late, 50)),
            late_p99_ms=float(np.percentile(late, 99)),
            metrics=assignment.metrics(trace) if phases.task_ticks else {},
            events=tuple(self.events),
            trace=trace,
            log=log,
            interrupted=interrupted,
            criteria=tuple(assignment.criteria(trace)) if phases.task_ticks else (),
            task_began=self._began,
        )


def _outcome(phases: Phases, guard: Guard, success: bool) -> str:
    if phases.ended is not None:
        return "succeeded" if success else "timed_out" if phases.ended == "time" else "failed"
    if guard.cause == "fall":
        return "fell"
    return "interrupted" if guard.cause == "interrupt" else "stopped"

"""How a run went, in words. Every time that is shown counts from the beginning of the task, tick 0 of it."""

from __future__ import annotations

import math
import re
import textwrap
from collections.abc import Iterable, Iterator
from dataclasses import dataclass

from servoid.stack.runtime.result import Result
from servoid.stack.safety.event import Event

OUTCOMES = {
    "succeeded": "goal met",
    "failed": "goal not met",
    "fell": "the robot fell",
    "timed_out": "goal not met in time,",
    "stopped": "stopped by the guard",
    "interrupted": "interrupted",
    "error": "ended by an error of the program",
}
# What an event is about, by its kind.
ABOUT = {
    "rejected": "target refused",
    "fall": "fall",
    "stale": "sensors",
    "late": "bus",
    "button": "stop button",
    "servo": "servo error",
    "temperature": "heat",
    "voltage": "supply",
    "overload": "blocked joint",
    "derated": "weaker joint",
    "homing": "homing",
    "policy": "policy",
    "plan": "planner",
    "skill": "skill",
    "act": "act",
    "record": "flight log",
    "interrupt": "interrupt",
    "system": "machine",
    "robot": "another robot",
}
COURSE = ("phase", "task")  # kinds of the events that every run has: its course
_TICK = re.compile(r"\btick (\d+)|(?<=ready at )(\d+)|(?<=that of )(\d+)")  # of the task, in what the planner says


@dataclass(frozen=True)
class Fold:
    """Events that say the same but for their numbers: the first of them, how many they are, and when the last came."""

    first: Event
    count: int
    last: float  # s


def fold(events: Iterable[Event]) -> list[Fold]:
    """Events of a kind that came again and again, as one; in the order in which they came first."""
    found: dict[tuple[str, str | None, str], Fold] = {}
    for event in events:
        key = event.kind, event.joint, re.sub(r"[\d.]+", "#", event.text)
        before = found.get(key)
        found[key] = Fold(event, 1, event.time) if before is None else Fold(before.first, before.count + 1, event.time)
    return list(found.values())


def told(event: Event, dt: float) -> str:
    """What an event is about, and what it says; a planner's ticks of `dt` s as times."""
    text = event.text
    if event.kind == "plan":
        text = _TICK.sub(lambda match: f"{int(match[match.lastindex or 1]) * dt:.2f} s", text)
    return f"{ABOUT.get(event.kind, event.kind)}: {text}"


def summary(result: Result, columns: int | None = None) -> Iterator[str]:
    """Lines about a run, none longer than so many columns: what happened, how it ended, what it lacked, its figures."""
    began, dt = result.task_began, result.trace.dt
    for what in fold(event for event in result.events if event.kind not in COURSE):
        again = f" ({what.count} times, until {what.last - (began or 0.0):.2f} s)" if what.count > 1 else ""
        head = f"{what.first.time - (began or 0.0):7.2f} s  "
        yield from _wrapped(head, told(what.first, dt) + again, columns)
    if began is None:
        yield f"{OUTCOMES[result.outcome]} before the task began (times count from the start of the run)"
    else:
        yield f"{OUTCOMES[result.outcome]} after {result.seconds:.2f} s (times count from the start of the task)"
    if result.outcome in ("failed", "timed_out"):
        for criterion in result.criteria:
            if not criterion.met:
                yield from _wrapped("  not met: ", str(criterion), columns)
    for name, value in result.metrics.items():
        yield f"{name:>24}: " + ("-" if math.isnan(value) else f"{value:.3f}")
    yield (
        f"{result.ticks} ticks, {result.missed} missed, late p50 {result.late_p50_ms:.2f} ms,"
        f" p99 {result.late_p99_ms:.2f} ms"
    )


def _wrapped(head: str, text: str, columns: int | None) -> list[str]:
    if columns is None:
        return [head + text]
    blank = " " * len(head)
    return textwrap.wrap(text, max(columns - 1, 40), initial_indent=head, subsequent_indent=blank)

"""From episodes to the rows of a table."""

from __future__ import annotations

import math
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from servoid.tools.common.confidence import LEAST, bootstrap, wilson
from servoid.tools.evaluate.spec import Beside, Row, cut_short


@dataclass(frozen=True)
class Measured:
    """What came of a row's run: records of its episodes, or why there are none."""

    records: Sequence[Mapping[str, Any]] = ()
    training: str | None = None  # how the network that the row needs is trained
    refused: str | None = None  # why the run cannot be done


def table(rows: Sequence[Row], measured: Mapping[str, Measured]) -> list[dict[str, Any]]:
    """The rows as JSON values, in order; `measured` by the rows' names.

    `value` is null where nothing was measured. `reached` is null where no figure is to be reached, and false where one
    is and nothing was measured.
    """
    values = {row.name: _value(row, measured[row.name]) for row in rows}
    return [_line(row, measured[row.name], values) for row in rows]


def _value(row: Row, measured: Measured) -> float | None:
    values = row.metric.values(measured.records)
    return math.fsum(values) / len(values) if values else None


def _line(row: Row, measured: Measured, values: Mapping[str, float | None]) -> dict[str, Any]:
    sample, value, figure = row.metric.values(measured.records), values[row.name], _figure(row, values)
    interval = None
    if sample:
        interval = wilson(round(math.fsum(sample)), len(sample)) if row.metric.share else bootstrap(sample)
    return {
        "paper": row.paper,
        "row": row.title,
        "name": row.name,
        "published": row.published,
        "published_unit": row.metric.unit if row.published_unit is None else row.published_unit,
        "figure": figure,
        "value": value,
        "ci95": interval,
        "unit": row.metric.unit,
        "episodes": len(sample),
        "reached": _reached(row, value, figure),
        "lower_is_better": row.metric.lower,
        "note": _note(row, measured, sample, interval),
    }


def _figure(row: Row, values: Mapping[str, float | None]) -> float | None:
    if not isinstance(row.figure, Beside):
        return row.figure
    other = values[row.figure.row]
    return None if other is None else row.figure.factor * other


def _reached(row: Row, value: float | None, figure: float | None) -> bool | None:
    """By the value itself, not by its interval."""
    if row.figure is None:
        return None
    if value is None or figure is None:
        return False
    return value <= figure if row.metric.lower else value >= figure


def _note(row: Row, measured: Measured, sample: Sequence[float], interval: Sequence[float] | None) -> str:
    parts, counted = [row.note], len(sample)
    if measured.training is not None:
        parts.append(f"needs training: {measured.training}")
    if measured.refused is not None:
        parts.append(f"refused: {measured.refused}")
    if not measured.records and measured.training is None and measured.refused is None:
        parts.append("not measured: no time was left")
    elif counted < len(measured.records):
        why = (
            "did not succeed"
            if row.metric.unfinished == "left out"
            else "had ended before there was anything to measure"
        )
        parts.append(f"{len(measured.records) - counted} {why}")
    stopped = sum(record.get("outcome") == "stopped" for record in measured.records)
    if row.metric.unfinished == "until then" and not row.metric.share:
        early = sum(cut_short(record) and bool(row.metric.values([record])) for record in measured.records)
        parts.append(f"{early} fell or were stopped, and count until then" if early else "")
    elif stopped:
        parts.append(f"{stopped} stopped by the guard, not for a fall")
    if sample and interval is None:
        parts.append("no interval: " + (f"fewer than {LEAST} episodes" if counted < LEAST else "all values are equal"))
    return "; ".join(part for part in parts if part)

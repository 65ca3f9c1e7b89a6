"""From episodes to rows, and rows as a table for a person, as Markdown and as CSV."""

from __future__ import annotations

import csv
import io
import math
import statistics
from collections.abc import Iterable, Mapping, Sequence
from dataclasses import dataclass
from typing import Any

from servoid.tools.common.confidence import LEAST, bootstrap, wilson
from servoid.tools.evaluate.metrics import fell_or_broken_off
from servoid.tools.evaluate.spec import Beside, Row

HEAD = ("paper", "row", "published", "to reach", "measured", "95 %", "episodes", "reached", "note")
COLUMNS = (
    "paper", "row", "name", "published", "published_unit", "figure", "value", "ci95_low", "ci95_high", "unit",
    "episodes", "reached", "lower_is_better", "note",
)  # fmt: skip


@dataclass(frozen=True)
class Measured:
    """What came of a row's experiment: records of its episodes, or why there are none."""

    records: Sequence[Mapping[str, Any]] = ()
    training: str | None = None  # how the network that the row needs is trained
    refused: str | None = None  # why the experiment cannot be done


def table(rows: Sequence[Row], measured: Mapping[str, Measured]) -> list[dict[str, Any]]:
    """The rows as JSON values, in order; `measured` by the rows' names.

    `value` is null where nothing was measured. `reached` is null where no figure is to be reached, or nothing was
    measured.
    """
    values = {row.name: _value(row, measured[row.name]) for row in rows}
    return [_line(row, measured[row.name], values) for row in rows]


def _value(row: Row, measured: Measured) -> float | None:
    values = row.metric.values(measured.records)
    if not values:
        return None
    return statistics.median(values) if row.metric.median else math.fsum(values) / len(values)


def _line(row: Row, measured: Measured, values: Mapping[str, float | None]) -> dict[str, Any]:
    sample, value, figure = row.metric.values(measured.records), values[row.name], _figure(row, values)
    interval = None
    if sample:
        share = row.metric.share
        interval = wilson(round(math.fsum(sample)), len(sample)) if share else bootstrap(sample, row.metric.median)
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
        "reached": _reached(row, measured, value, figure),
        "lower_is_better": row.metric.lower,
        "note": _note(row, measured, sample, interval),
    }


def _figure(row: Row, values: Mapping[str, float | None]) -> float | None:
    if not isinstance(row.figure, Beside):
        return row.figure
    other = values[row.figure.row]
    return None if other is None else row.figure.factor * other


def _reached(row: Row, measured: Measured, value: float | None, figure: float | None) -> bool | None:
    """By the value itself, not by its interval. Where all episodes failed, and there is none, it was not reached."""
    if figure is None or not measured.records:
        return None
    if value is None:
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
    elif not counted and (known := row.metric.unknown(measured.records)):
        parts.append(f"the task measures no '{row.metric.of}', but {known}")
    elif counted < len(measured.records):
        why = (
            "did not succeed"
            if row.metric.unfinished == "left out"
            else "had ended before there was anything to measure"
        )
        parts.append(f"{len(measured.records) - counted} {why}")
    stopped = sum(record.get("outcome") == "stopped" for record in measured.records)
    if row.metric.unfinished == "until then" and not row.metric.share:
        early = sum(fell_or_broken_off(record) and bool(row.metric.values([record])) for record in measured.records)
        parts.append(f"{early} fell or were stopped, and count until then" if early else "")
    elif stopped:
        parts.append(f"{stopped} stopped by the guard, not for a fall")
    if sample and interval is None:
        parts.append("no interval: " + (f"fewer than {LEAST} episodes" if counted < LEAST else "all values are equal"))
    return "; ".join(part for part in parts if part)


def cells(line: Mapping[str, Any]) -> list[str]:
    """A row of the table for a person, under HEAD."""
    bound = "at most " if line["lower_is_better"] else "at least "
    figure = "" if line["figure"] is None else bound + quantity(line["figure"], line["unit"])
    low_high = "" if line["ci95"] is None else " to ".join(number(x, 3) for x in line["ci95"])
    reached = {True: "yes", False: "no", None: ""}[line["reached"]]
    return [
        line["paper"],
        line["row"],
        quantity(line["published"], line["published_unit"]),
        figure,
        quantity(line["value"], line["unit"]) or "none",
        low_high,
        str(line["episodes"]),
        reached,
        line["note"],
    ]


def quantity(value: float | None, unit: str) -> str:
    """A number to three or four digits with its unit; nothing for None."""
    return "" if value is None else f"{number(value, 4)} {unit}".strip()


def number(value: float, digits: int) -> str:
    """A number to so many digits, and all of those before the point: 3000 and not 3e+03."""
    return f"{value:.0f}" if abs(value) + 0.5 >= 10**digits else f"{value:.{digits}g}"


def markdown(title: str, facts: Iterable[str], lines: Sequence[Mapping[str, Any]], below: Iterable[str]) -> str:
    """A page: facts about the evaluation, the table, and what is to be said below it."""
    rows = [HEAD, ["---"] * len(HEAD), *(cells(line) for line in lines)]
    table = ["| " + " | ".join(cell.replace("|", "\\|") for cell in row) + " |" for row in rows]
    return "\n".join([f"# {title}", "", *(f"- {fact}" for fact in facts), "", *table, "", *below, ""])


def as_csv(lines: Sequence[Mapping[str, Any]]) -> str:
    """The rows as CSV, nothing rounded; what is not there is empty."""
    text = io.StringIO()
    writer = csv.DictWriter(text, COLUMNS, extrasaction="ignore", lineterminator="\n")
    writer.writeheader()
    for line in lines:
        low, high = line["ci95"] or (None, None)
        writer.writerow({**line, "ci95_low": low, "ci95_high": high})
    return text.getvalue()

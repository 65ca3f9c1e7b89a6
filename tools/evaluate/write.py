"""The table as Markdown and CSV."""

from __future__ import annotations

import csv
import io
from collections.abc import Iterable, Mapping, Sequence
from typing import Any

HEAD = ("paper", "row", "published", "to reach", "measured", "95 %", "episodes", "reached", "note")
COLUMNS = (
    "paper", "row", "name", "published", "published_unit", "figure", "value", "ci95_low", "ci95_high", "unit",
    "episodes", "reached", "lower_is_better", "note",
)  # fmt: skip


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

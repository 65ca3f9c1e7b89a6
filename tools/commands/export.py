"""Write a flight log as two tables: ticks, with one column per number, and events.

They are named after the log (demo.mcap: demo-ticks.csv, demo-events.csv) and written beside it, or to --out. Columns
are named by channel, field and joint, axis or foot: observation.position.l_knee. What was not measured is empty.
docs/files.md explains each field.
"""

from __future__ import annotations

import argparse
from collections.abc import Callable, Iterator, Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.tools.common import exit_codes
from servoid.tools.common.output import add_json_argument, reporting

if TYPE_CHECKING:
    from servoid.stack.log.flightlog import FlightLog

CHANNELS = ("/observation", "/command", "/state", "/instruction", "/timing")
_AXES = {3: ("x", "y", "z"), 4: ("w", "x", "y", "z"), 2: ("x", "y")}

Columns = dict[str, Array]


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", type=Path, metavar="LOG", help="flight log (.mcap)")
    kind = parser.add_mutually_exclusive_group(required=True)
    kind.add_argument("--csv", action="store_true", help="comma-separated text")
    kind.add_argument("--parquet", action="store_true", help="Apache Parquet; needs the 'train' extra")
    parser.add_argument("--out", type=Path, metavar="DIR", help="folder to write into (default: the log's)")
    parser.add_argument("--replace", action="store_true", help="overwrite existing tables")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Raises ConfigError."""
    from servoid.stack.log.flightlog import read_log

    with reporting(args.json) as report:
        suffix, write = (".csv", _write_csv) if args.csv else (".parquet", _parquet_writer())
        log = read_log(args.log)
        folder = args.log.parent if args.out is None else args.out
        paths = {name: folder / f"{args.log.stem}-{name}{suffix}" for name in ("ticks", "events")}
        for path in paths.values():
            if path.exists() and not args.replace:
                raise ConfigError(f"{path}: already exists: use --replace, or choose another folder with --out")
        tables = {"ticks": ticks_table(log), "events": events_table(log)}
        rows = {name: len(next(iter(table.values()))) for name, table in tables.items()}
        try:
            folder.mkdir(parents=True, exist_ok=True)
            for name, path in paths.items():
                write(path, tables[name])
        except OSError as error:
            raise ConfigError(f"{folder}: cannot be written ({error.strerror}): choose another with --out") from None
        for name, path in paths.items():
            report.line(f"{path}: {rows[name]} rows, {len(tables[name])} columns")
        if not log.complete:
            report.line("the log was cut short: this is what there is of it")
        files = {name: {"path": path, "rows": rows[name], "columns": len(tables[name])} for name, path in paths.items()}
        report.result({"complete": log.complete} | files)
    return exit_codes.DONE


def ticks_table(log: FlightLog) -> Columns:
    """A row for each tick of the log: `tick`, `time` [s since its first], and every field that has one size all along.

    A channel that says nothing of a tick has empty cells there (NaN, or an empty text).
    """
    ticks = log.ticks("/observation")
    columns: Columns = {"tick": ticks, "time": (ticks - ticks[0] if len(ticks) else ticks) * _dt(log)}
    names, feet = _names(log)
    for channel in CHANNELS:
        rows = np.searchsorted(ticks, log.ticks(channel))
        for field in _fields(log, channel):
            values = log.column(channel, field)
            for label, column in _split(channel.strip("/") + f".{field}", values, names, feet):
                columns[label] = _spread(column, rows, len(ticks))
    return columns


def events_table(log: FlightLog) -> Columns:
    """A row for each event: `tick`, `time` [s], `kind`, `joint`, `text`."""
    found = log.messages["/event"]
    return {
        key: np.array([("" if event[key] is None else event[key]) for event in found], dtype=kind)
        for key, kind in (("tick", int), ("time", float), ("kind", object), ("joint", object), ("text", object))
    }


def _dt(log: FlightLog) -> float:
    return 1.0 / float(log.header["robot"]["rate"])


def _names(log: FlightLog) -> tuple[list[str], list[str]]:
    robot = log.header["robot"]
    return [joint["name"] for joint in robot["joints"]], list(robot["feet"])


def _fields(log: FlightLog, channel: str) -> Iterator[str]:
    """Fields that every message of a channel has, in one shape."""
    found = log.messages[channel]
    for field in found[0] if found else ():
        if field != "tick" and all(field in message for message in found):
            shapes = {tuple(m[field]["shape"]) if isinstance(m[field], dict) else () for m in found}
            if len(shapes) == 1:
                yield field


def _split(label: str, values: Array, joints: Sequence[str], feet: Sequence[str]) -> Iterator[tuple[str, Array]]:
    """One column for each number of a field `(rows, ...)`."""
    if values.ndim == 1:
        yield label, values
        return
    size = values.shape[1]
    if values.ndim > 2:  # a list of points has no columns
        return
    parts: Sequence[str] = [str(i) for i in range(size)]
    if size == len(joints):
        parts = joints
    elif label.endswith(".contact"):
        parts = feet
    elif size in _AXES:
        parts = _AXES[size]
    for i, part in enumerate(parts):
        yield f"{label}.{part}", values[:, i]


def _spread(column: Array, rows: Array, count: int) -> Array:
    """A column of some ticks over all of them."""
    if len(column) == count:
        return column
    empty = np.full(count, np.nan) if column.dtype.kind in "fiu" else np.full(count, "", dtype=object)
    empty[rows] = column
    return empty


def _write_csv(path: Path, table: Columns) -> None:
    import csv

    def text(value: Any) -> Any:
        return "" if isinstance(value, float | np.floating) and not np.isfinite(value) else value

    with path.open("w", newline="") as file:
        writer = csv.writer(file)
        writer.writerow(table)
        writer.writerows([text(value) for value in row] for row in zip(*table.values(), strict=True))


def _parquet_writer() -> Callable[[Path, Columns], None]:
    import pyarrow
    from pyarrow import parquet

    def write(path: Path, table: Columns) -> None:
        parquet.write_table(pyarrow.table({key: pyarrow.array(list(value)) for key, value in table.items()}), path)

    return write

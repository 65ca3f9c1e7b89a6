"""List the tasks with their settings, to be changed with --set key=value."""

from __future__ import annotations

import argparse
import typing
from dataclasses import fields, is_dataclass
from typing import Any

from servoid.stack import tasks
from servoid.tools.common import exit_codes
from servoid.tools.common.output import add_json_argument, reporting


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("task", nargs="?", help="only this one")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        names = tasks.names() if args.task is None else (args.task,)
        described = [describe(name) for name in names]
        for task in described:
            report.line(f"{task['name']}: {task['description']}")
            rows = [(f"  {row['key']}", row["value"], row["help"]) for row in task["settings"]]
            report.table(("  setting", "value", ""), rows)
            report.line()
        report.result({"tasks": described})
    return exit_codes.DONE


def describe(name: str) -> dict[str, Any]:
    """Name, description and settings of a task. Raises ConfigError."""
    return {"name": name, "description": tasks.description(name), "settings": _settings(tasks.load_settings(name))}


def _settings(value: Any, prefix: str = "") -> list[dict[str, str]]:
    """Rows of key, value as it is typed, and help; parts with settings of their own are listed with dots."""
    hints = typing.get_type_hints(type(value), include_extras=True)
    rows = []
    for f in fields(value):
        item = getattr(value, f.name)
        if is_dataclass(item):
            rows += _settings(item, f"{prefix}{f.name}.")
        else:
            help_text = getattr(hints[f.name], "__metadata__", ("",))[0]
            rows.append({"key": prefix + f.name, "value": _text(item), "help": help_text})
    return rows


def _text(value: Any) -> str:
    """A value as it is typed after `key=`."""
    if isinstance(value, tuple):
        nested = any(isinstance(item, tuple) for item in value)
        return ":".join(_text(item).replace(":", ",") if nested else _text(item) for item in value)
    if isinstance(value, bool):
        return str(value).lower()
    return "" if value is None else f"{value:g}" if isinstance(value, (int, float)) else str(value)

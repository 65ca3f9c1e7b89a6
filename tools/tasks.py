"""List the tasks with their settings, to be changed with --set key=value."""

from __future__ import annotations

import argparse
import typing
from dataclasses import fields, is_dataclass
from typing import Any

from stack import tasks
from tools import exit_codes
from tools.output import add_json_argument, reporting


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
    cls = tasks.task_class(name)
    return {"name": name, "description": cls.description, "settings": _settings(tasks.load_settings(name))}


def _settings(value: Any, prefix: str = "") -> list[dict[str, str]]:
    """Rows of key, value as it is typed, and help; parts with settings of their own are listed with dots."""
    hints = typing.get_type_hints(type(value), include_extras=True)
    rows = []
    for f in fields(value):
        item = getattr(value, f.name)
        if is_dataclass(item):
            rows += _settings(item, f"{prefix}{f.name}.")
        else:
            text = ":".join(f"{v:g}" for v in item) if isinstance(item, tuple) else "" if item is None else f"{item:g}"
            help_text = getattr(hints[f.name], "__metadata__", ("",))[0]
            rows.append({"key": prefix + f.name, "value": text, "help": help_text})
    return rows

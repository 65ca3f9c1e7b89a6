"""List the tasks, or explain the settings of one, which --set KEY=VALUE changes."""

from __future__ import annotations

import argparse
import shutil
import textwrap
from dataclasses import asdict
from typing import Any

from servoid.hw.config import ConfigError
from servoid.hw.setting import explain
from servoid.stack import tasks
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Report, add_json_argument, reporting


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("task", nargs="?", metavar="TASK", help="task to explain: a name or FILE.py:Class")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        if args.task is not None:
            described = [describe(args.task)]
            _explain(report, described[0])
        else:
            described = [_describe_if_possible(name) for name in tasks.names()]
            width = max(len(task["name"]) for task in described)
            for task in described:
                report.line(f"{task['name']:{width}}  {task['description']}")
            report.line()
            report.line("servoid tasks TASK explains a task's settings; servoid run TASK runs it")
        report.result({"tasks": described})
    return exit_codes.DONE


def describe(name: str) -> dict[str, Any]:
    """Name, description, source and settings of a task. Raises ConfigError."""
    return {
        "name": name,
        "description": tasks.find(name).description,
        "source": tasks.source(name),
        "settings": [asdict(setting) for setting in explain(tasks.load_settings(name))],
    }


def _describe_if_possible(name: str) -> dict[str, Any]:
    """An installed package whose task cannot be loaded does not hide the others."""
    try:
        return describe(name)
    except ConfigError as error:
        return {"name": name, "description": f"cannot be used: {error}", "source": None, "settings": []}


def _explain(report: Report, task: dict[str, Any]) -> None:
    """A task's settings in lines of the terminal's width, at most 100."""
    report.line(f"{task['name']}: {task['description']}")
    report.line()
    rows = [(row["key"], row["value"], row["unit"], _sentence(row)) for row in task["settings"]]
    head = ("setting", "value", "unit", "")
    widths = [min(max(len(row[i]) for row in (head, *rows)), most) for i, most in enumerate((20, 15, 11))]
    room = max(min(shutil.get_terminal_size().columns, 100) - sum(widths) - 8, 20)
    for key, value, unit, text in (head, *rows):
        first, *rest = textwrap.wrap(text, room) or [""]
        if len(key) > widths[0] or len(value) > widths[1]:
            report.line(f"  {key}  {value}")
            key = value = ""
        report.line(f"  {key:{widths[0]}}  {value:{widths[1]}}  {unit:{widths[2]}}  {first}".rstrip())
        for more in rest:
            report.line(" " * (sum(widths) + 8) + more)
    report.line()
    report.line("change one with --set SETTING=VALUE; a range is typed low:high")


def _sentence(row: dict[str, str]) -> str:
    return "; ".join(part for part in (row["text"], row["range"]) if part)

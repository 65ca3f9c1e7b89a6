"""Argument parsing that offers the nearest name for a mistyped one."""

from __future__ import annotations

import argparse
import difflib
import sys
from collections.abc import Iterable, Sequence
from typing import Any, NoReturn

from servoid.hw.config import ConfigError
from servoid.tools.common import exit_codes
from servoid.tools.common.output import say


class Parser(argparse.ArgumentParser):
    """An ArgumentParser whose errors are one line, with the nearest option. Options are not abbreviated."""

    def __init__(self, **options: Any) -> None:
        options.setdefault("allow_abbrev", False)
        super().__init__(**options)

    def parse_args(  # type: ignore[override]
        self, args: Sequence[str] | None = None, namespace: argparse.Namespace | None = None
    ) -> argparse.Namespace:
        parsed, unknown = self.parse_known_args(args, namespace)
        if unknown:
            name = unknown[0].split("=")[0]
            kind = "option" if name.startswith("-") else "argument"
            self.error(f"unknown {kind} '{name}'{suggestion(name, self._option_string_actions)}")
        return parsed

    def _get_values(self, action: argparse.Action, arg_strings: list[str]) -> Any:
        """argparse takes `--option=--` for an empty list."""
        if action.option_strings and "--" in arg_strings:
            raise argparse.ArgumentError(action, "'--' is no value")
        return super()._get_values(action, arg_strings)

    def error(self, message: str) -> NoReturn:
        say(f"{self.prog}: {message} (see {self.prog} --help)", sys.stderr)
        raise SystemExit(exit_codes.USAGE)


def suggestion(name: str, known: Iterable[str]) -> str:
    """The nearest known name as the end of a sentence, or nothing."""
    close = difflib.get_close_matches(name, list(known), n=1)
    return f"; did you mean '{close[0]}'?" if close else ""


def positive(text: str) -> float:
    """An argument that is a positive number."""
    try:
        value = float(text)
    except ValueError:
        value = -1.0
    if not 0.0 < value < float("inf"):
        raise argparse.ArgumentTypeError(f"'{text}' is not a positive number")
    return value


def counted(text: str) -> int:
    """An argument that is a number of things: 1 or more."""
    try:
        value = int(text)
    except ValueError:
        value = 0
    if value < 1:
        raise argparse.ArgumentTypeError(f"'{text}' is not a number from 1 on")
    return value


def check_seed(seed: int) -> None:
    """Raise ConfigError for a `--seed` that no generator takes."""
    if seed < 0:
        raise ConfigError(f"--seed must not be negative, not {seed}")


def add_set_argument(parser: argparse.ArgumentParser) -> None:
    """`--set key=value`, any number of times; read it with `settings(args)`."""
    parser.add_argument(
        "--set",
        action="append",
        default=[],
        metavar="KEY=VALUE",
        help="change a setting of the task (see servoid tasks TASK)",
    )


def add_recover_argument(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--recover",
        action="store_true",
        help="let a robot that falls get up and continue (default: a fall ends the run)",
    )


def add_gain_argument(parser: argparse.ArgumentParser) -> None:
    """`--gain G`, for `RunSettings.gain`."""
    parser.add_argument(
        "--gain",
        type=float,
        default=1.0,
        metavar="G",
        help="factor on the servos' position gain; below 1 is softer (default: 1)",
    )


def settings(args: argparse.Namespace) -> dict[str, str]:
    """The settings given with `--set`. Raises ConfigError for one without a value or given twice."""
    result: dict[str, str] = {}
    for item in args.set:
        key, equals, value = item.partition("=")
        if not equals or not key:
            raise ConfigError(f"--set {item}: write --set key=value")
        if key in result:
            raise ConfigError(f"--set {item}: {key} is set twice")
        result[key] = value
    return result


def out_of_reach(args: argparse.Namespace) -> list[str]:
    """A sentence about each speed that is asked of the chosen robot and is more than it can. Raises ConfigError."""
    from servoid.hw.robot.description import load_robot
    from servoid.stack.tasks import beyond, load_settings

    robot = load_robot(args.robot)
    return beyond(load_settings(args.task, settings(args), robot), robot)

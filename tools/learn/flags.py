"""A frozen dataclass of settings as flags of a command: its defaults, its texts, its types."""

from __future__ import annotations

import argparse
import re
import typing
from collections.abc import Callable
from dataclasses import asdict, fields, is_dataclass, replace
from typing import Any, TypeVar

from servoid.hw.config import ConfigError, load_yaml, parse_number, resolve
from servoid.tools.learn.planner_settings import PLANNER_TITLES
from servoid.tools.learn.prior_settings import PRIOR_TITLES
from servoid.tools.learn.settings import TITLES as COMMON_TITLES
from servoid.tools.learn.settings import StepRun, TrainingRun

T = TypeVar("T", bound=TrainingRun)
TITLES = {**COMMON_TITLES, **PLANNER_TITLES, **PRIOR_TITLES}


def add_setting_flags(parser: argparse.ArgumentParser, base: TrainingRun, run: argparse._ArgumentGroup) -> None:
    """A flag for each setting of `base`, grouped by `TITLES`; settings of the run itself go into the group `run`.

    A flag that is not given leaves nothing in the namespace, so that a file may say otherwise: see `read_settings`.
    """
    groups = {TITLES[TrainingRun]: run}
    for title in dict.fromkeys(TITLES.values()):
        for f in fields(base):
            owner = _owner(type(base), f.name)
            if TITLES[owner] != title:
                continue
            if title not in groups:
                groups[title] = parser.add_argument_group(title)
            hint = typing.get_type_hints(owner, include_extras=True)[f.name]
            kind, text = typing.get_args(hint)
            default = getattr(base, f.name)
            shown = "" if isinstance(default, dict) else f" (default: {_shown(default)})"
            groups[title].add_argument(
                *_flags(f.name),
                dest=f.name,
                default=argparse.SUPPRESS,
                help=(text + shown).replace("%", "%%"),
                **_parsed(kind),
            )


def read_settings(args: argparse.Namespace, base: T) -> T:
    """`base`, changed by the file of `--config`, and by the flags that were given on top. Raises ConfigError."""
    if args.config is not None:
        base = load_yaml(resolve("training", args.config), type(base))
    given: dict[str, Any] = {}
    for f in fields(base):
        if f.name in args:
            value, present = getattr(args, f.name), getattr(base, f.name)
            given[f.name] = {**present, **dict(value)} if isinstance(present, dict) else _frozen(value)
    if "minutes" in given and isinstance(base, StepRun):
        given.setdefault("steps", 0)  # minutes that are typed mean more than steps that are not
    try:
        return replace(base, **given)
    except ValueError as error:
        flags = re.sub(r"\b(" + "|".join(given) + r")\b", lambda found: "--" + found[0].replace("_", "-"), str(error))
        raise ConfigError(flags) from error


def plain(settings: TrainingRun) -> dict[str, Any]:
    """Settings as YAML has them, for a header, or for a file that `--config` takes."""
    return {name: list(value) if isinstance(value, tuple) else value for name, value in asdict(settings).items()}


def _flags(name: str) -> tuple[str, ...]:
    """The flag of a setting, and the one that it had before."""
    older = {"inference_delay": ("--committed",)}
    return "--" + name.replace("_", "-"), *older.get(name, ())


def _owner(cls: type, name: str) -> type:
    """The class that declares a setting first; one that only changes its default need not repeat its text."""
    declaring = (base for base in reversed(cls.__mro__) if is_dataclass(base))
    return next(base for base in declaring if name in {f.name for f in fields(base)})


def _shown(value: Any) -> str:
    """A default as it is typed."""
    if isinstance(value, tuple):
        return " ".join(map(_shown, value)) or "none"
    if isinstance(value, bool):
        return "yes" if value else "no"
    if isinstance(value, float):
        return f"{value:g}".replace("e+0", "e")
    return str(value) or "none"


def _parsed(hint: Any) -> dict[str, Any]:
    """What argparse is told about a setting of this type."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if hint is bool:
        return {"action": argparse.BooleanOptionalAction}
    if origin is typing.Literal:
        return {"choices": arguments}
    if origin is dict:
        return {"nargs": "+", "metavar": "NAME=WEIGHT", "type": _pair}
    if origin is tuple and arguments[-1] is Ellipsis:
        return {
            "nargs": "*" if arguments[0] is str else "+",
            "type": _scalar(arguments[0]),
            "metavar": _META[arguments[0]],
        }
    if origin is tuple:
        return {"nargs": len(arguments), "type": _scalar(arguments[0]), "metavar": ("FIRST", "LAST")}
    return {"type": _scalar(hint), "metavar": _META[hint]}


_META = {int: "N", float: "X", str: "NAME"}


def _scalar(hint: Any) -> Callable[[str], Any]:
    if hint is str:
        return str

    def number(text: str) -> int | float:
        try:
            return parse_number(text, hint)
        except ValueError as error:
            raise argparse.ArgumentTypeError(f"expected {error}, not '{text}'") from error

    return number


def _pair(text: str) -> tuple[str, float]:
    name, equals, value = text.partition("=")
    if not equals:
        raise argparse.ArgumentTypeError(f"expected NAME=WEIGHT, not '{text}'")
    return name, float(_scalar(float)(value))


def _frozen(value: Any) -> Any:
    return tuple(value) if isinstance(value, list) else value

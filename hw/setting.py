"""A setting's text, unit and range, written beside its field: `x: Annotated[float, Setting("how far", "m", above=0)]`.

The range that is shown is the range that is checked. `overrides` changes settings from a command line.
"""

from __future__ import annotations

import functools
import typing
from collections.abc import Callable, Iterator
from dataclasses import dataclass, fields, is_dataclass, replace
from typing import Any, Literal, TypeVar

Range = tuple[float, float]  # low, high
Way = Literal["forward", "backward", "left", "turning"]
T = TypeVar("T")


@dataclass(frozen=True)
class Setting:
    """What a field of a frozen dataclass is for. `above` is an open end of its range, `least` and `most` are closed.

    `asks` says which way the robot is asked to go so fast: the robot's file says how fast it can at most. `of` says
    what else of the robot it follows: a length its height, a time the cycle of its gait.
    """

    text: str
    unit: str = ""
    above: float | None = None
    least: float | None = None
    most: float | None = None
    asks: Way | None = None
    of: Literal["height", "cycle"] | None = None

    @property
    def robots(self) -> bool:
        """Whether it is another number for another robot."""
        return self.asks is not None or self.of is not None

    @property
    def range(self) -> str:
        """The range in words; empty where none is checked."""
        if self.least is not None and self.most is not None:
            return f"{self.least:g} to {self.most:g}"
        ends = [("above", self.above), ("at least", self.least), ("at most", self.most)]
        return ", ".join(f"{word} {end:g}" for word, end in ends if end is not None)

    def problem(self, value: float) -> str:
        """What is wrong with `value`; empty where it is in the range."""
        low = (self.above is None or value > self.above) and (self.least is None or value >= self.least)
        if low and (self.most is None or value <= self.most):
            return ""
        if self.above == 0.0 and not low:
            return f"must be positive, not {value:g}"
        if self.least == 0.0 and not low:
            return f"must not be negative: {value:g}"
        return f"must be {self.range}, not {value:g}"


@dataclass(frozen=True)
class Explained:
    """A setting with its value. A part's settings have names with dots, as `--set` takes them."""

    key: str
    value: str  # as it is typed after `key=`
    text: str
    unit: str
    range: str


def check(settings: Any) -> None:
    """Raise ValueError, which begins with the setting's name, for the first value outside its range."""
    for name, setting, ordered in _described(type(settings)):
        value = getattr(settings, name)
        if ordered and value[0] > value[1]:
            raise ValueError(f"{name}: upside down: {value[0]:g} is above {value[1]:g}; write low before high")
        for number in _numbers(value):
            if problem := setting.problem(number):
                raise ValueError(f"{name}: {problem}")


def asks(settings: Any, prefix: str = "") -> Iterator[tuple[str, str, Way, tuple[float, ...]]]:
    """Name, unit, way and speeds of each setting that asks for speeds, those of the dataclasses in it too."""
    for name, setting, _ in _described(type(settings)):
        if setting.asks is not None:
            yield prefix + name, setting.unit, setting.asks, tuple(_numbers(getattr(settings, name)))
    for f in fields(settings):
        if is_dataclass(part := getattr(settings, f.name)):
            yield from asks(part, f"{prefix}{f.name}.")


def rescaled(settings: T, factor: Callable[[Setting, float], float]) -> T:
    """The settings with each number that is the robot's times its factor, those of the dataclasses in it too."""

    def times(value: Any, setting: Setting) -> Any:
        if isinstance(value, tuple):
            return tuple(times(item, setting) for item in value)
        return None if value is None else value * factor(setting, value)

    described = _described(type(settings))
    values = {name: times(getattr(settings, name), setting) for name, setting, _ in described if setting.robots}
    parts = {f.name: getattr(settings, f.name) for f in fields(settings)}  # type: ignore[arg-type]
    values |= {name: rescaled(part, factor) for name, part in parts.items() if is_dataclass(part)}
    return replace(settings, **values)  # type: ignore[type-var]


def explain(settings: Any, prefix: str = "") -> Iterator[Explained]:
    """Each setting of a frozen dataclass, and then of the dataclasses in it."""
    known = {name: setting for name, setting, _ in _described(type(settings))}
    values = {f.name: getattr(settings, f.name) for f in fields(settings)}
    for name, value in values.items():
        if not is_dataclass(value):
            setting = known.get(name, Setting(""))
            yield Explained(prefix + name, as_typed(value), setting.text, setting.unit, setting.range)
    for name, value in values.items():
        if is_dataclass(value):
            yield from explain(value, f"{prefix}{name}.")


def as_typed(value: Any) -> str:
    """A value as it is typed after `key=`."""
    if isinstance(value, tuple):
        nested = any(isinstance(item, tuple) for item in value)
        return ":".join(as_typed(item).replace(":", ",") if nested else as_typed(item) for item in value)
    if isinstance(value, bool):
        return str(value).lower()
    return "none" if value is None else f"{value:g}" if isinstance(value, (int, float)) else str(value)


def _described(cls: Any) -> tuple[tuple[str, Setting, bool], ...]:
    """Name and setting of each field that has one, and whether its value is a range."""
    return _found(cls)


@functools.cache
def _found(cls: Any) -> tuple[tuple[str, Setting, bool], ...]:
    hints = typing.get_type_hints(cls, include_extras=True)
    found = []
    for f in fields(cls):
        extras = [extra for extra in getattr(hints[f.name], "__metadata__", ()) if isinstance(extra, Setting)]
        found += [(f.name, extra, typing.get_args(hints[f.name])[0] == Range) for extra in extras[:1]]
    return tuple(found)


def _numbers(value: Any) -> Iterator[float]:
    if isinstance(value, tuple):
        for item in value:
            yield from _numbers(item)
    elif isinstance(value, (int, float)):
        yield value

"""Settings of a frozen dataclass given as text, as on a command line: `--set key=value`."""

from __future__ import annotations

import re
import types
import typing
from dataclasses import is_dataclass, replace
from pathlib import Path
from typing import Any, TypeVar

from servoid.hw.config import ConfigError, hints_of, nearest, parse_number

T = TypeVar("T")


def override(base: T, settings: dict[str, str], where: str = "--set") -> T:
    """The dataclass instance `base` with some fields read from text, as typed on a command line.

    A field of a field is named with a dot. A pair of numbers is written `low:high`, or as one number for both; a list
    of points as `x,y:x,y`. Raises ConfigError naming the setting for an unknown key or a value that does not parse.
    """
    return _set(base, [(key, key, text) for key, text in settings.items()], where)


def _set(base: Any, settings: list[tuple[str, str, str]], where: str) -> Any:
    """`base` with (key, key as typed, text) read, all at once: values that are good together come in any order."""
    hints = hints_of(type(base))
    values: dict[str, Any] = {}
    inner: dict[str, list[tuple[str, str, str]]] = {}
    for key, full, text in settings:
        name, _, rest = key.partition(".")
        if name not in hints:
            raise ConfigError(f"{where} {full}={text}: unknown setting '{name}': {nearest(name, hints)}")
        if rest:
            if not is_dataclass(getattr(base, name)):
                raise ConfigError(f"{where} {full}={text}: '{name}' has no settings of its own")
            inner.setdefault(name, []).append((rest, full, text))
            continue
        try:
            values[name] = _parse(text.strip(), hints[name])
        except ValueError as error:
            raise ConfigError(f"{where} {full}={text}: expected {error}") from error
    values |= {name: _set(getattr(base, name), parts, where) for name, parts in inner.items()}
    try:
        return replace(base, **values)
    except ValueError as error:
        typed = [(key.partition(".")[0], f"{full}={text}") for key, full, text in settings]
        named = [words for name, words in typed if re.search(rf"\b{name}\b", str(error))]
        raise ConfigError(f"{where} {' '.join(named or [words for _, words in typed])}: {error}") from error


def _parse(text: str, hint: Any) -> Any:
    """A value from a command line's text. Raises ValueError saying what was expected."""
    origin, arguments = typing.get_origin(hint), typing.get_args(hint)
    if origin in (types.UnionType, typing.Union):
        if type(None) in arguments and text.lower() in ("none", "null"):
            return None
        expected = []
        for option in (a for a in arguments if a is not type(None)):
            try:
                return _parse(text, option)
            except ValueError as error:
                expected.append(str(error))
        raise ValueError(" or ".join(expected))
    if origin is tuple:
        inner = typing.get_origin(arguments[0]) is tuple
        parts = re.split(":" if inner else "[:,]", text) if text else []
        if arguments[-1] is Ellipsis:
            return tuple(_parse(part.strip(), arguments[0]) for part in parts)
        if len(parts) == 1 and arguments == (float, float):
            parts = parts * 2
        if len(parts) != len(arguments):
            raise ValueError(f"{len(arguments)} values separated by ':', got {len(parts)}")
        return tuple(_parse(part.strip(), option) for part, option in zip(parts, arguments, strict=True))
    if hint is bool:
        if text.lower() not in ("true", "false"):
            raise ValueError("true or false")
        return text.lower() == "true"
    if hint in (int, float):
        return parse_number(text, hint)
    if origin is typing.Literal:
        if text not in arguments:
            raise ValueError(f"one of {', '.join(map(str, arguments))}")
        return text
    if hint is str:
        if not text:
            raise ValueError("words, such as 'walk forward', or none")
        return text
    if hint is Path:
        return Path(text)
    raise ValueError("a single value; this setting can only be given in a file")

"""Strict YAML into frozen dataclasses: an error names the file, the line and the key.

The file is read as PyYAML's node graph, not as plain values, because only nodes know their line and only nodes show
a duplicate key. Scalars are then read by the type that the dataclass asks for: `1e-4` is a number although YAML 1.1
calls it a string, and `no` is never taken for a name although YAML 1.1 calls it a boolean.
"""

from __future__ import annotations

import difflib
import enum
import functools
import json
import math
import re
import types
import typing
from collections.abc import Iterable, Mapping
from dataclasses import MISSING, dataclass, field, fields, is_dataclass
from pathlib import Path
from typing import Any, NoReturn, TypeVar

import yaml

# Reads as SafeLoader does, eight times as fast, where PyYAML was built with libyaml.
YAML_LOADER: type[yaml.SafeLoader] = getattr(yaml, "CSafeLoader", yaml.SafeLoader)
CONFIGS = Path(__file__).resolve().parent.parent / "configs"
_SHOWN = 60  # characters of a value that an error shows

T = TypeVar("T")


class ConfigError(Exception):
    """A configuration that cannot be used: exit code 2."""


@dataclass(frozen=True)
class Marks:
    """The line of each key of a file; a key is a path such as `joints[3].range`, the whole file being ``""``."""

    path: Path
    lines: dict[str, int] = field(default_factory=dict)

    def error(self, key: str, message: str, at: str | None = None) -> ConfigError:
        """An error of `key`, with the line of `at` (default: `key`) or of the nearest key above that is in the file."""
        at = key if at is None else at
        while at not in self.lines and at:
            at = at[: max(at.rfind("."), at.rfind("["), 0)]
        return ConfigError(f"{self.path}:{self.lines.get(at, 1)}: {key + ': ' if key else ''}{message}")


def nearest(name: str, known: Iterable[str]) -> str:
    """The end of an error about an unknown name: the nearest known one, or all of them."""
    names = sorted(known)
    close = difflib.get_close_matches(name, names, n=1)
    return f"did you mean '{close[0]}'?" if close else f"known: {', '.join(names) or 'none'}"


def available(kind: str) -> tuple[str, ...]:
    """Names of the configurations of a kind ("robots", "tasks", ...)."""
    return tuple(sorted(path.stem for path in (CONFIGS / kind).glob("*.yaml")))


def resolve(kind: str, name: str | Path) -> Path:
    """Path of a configuration: a file as it is, or `configs/<kind>/<name>.yaml`.

    Written so, that one is found from every folder: as shipped, where there is no such file. Raises ConfigError with
    the nearest name when there is none.
    """
    path = Path(name)
    if path.suffix in (".yaml", ".yml") or path.name != str(name):
        if path.is_file():
            return path
        if path.parent == Path(CONFIGS.name, kind) and path.stem in available(kind):
            return CONFIGS / kind / path.name
        siblings = [p.name for p in path.parent.glob("*.y*ml")] if path.parent.is_dir() else []
        hint = nearest(path.name, siblings) if siblings else f"there is no YAML file in {path.parent}"
        raise ConfigError(f"{path}: no such file; {hint}; shipped: {', '.join(available(kind))}")
    if str(name) not in available(kind):
        raise ConfigError(f"unknown {kind.removesuffix('s')} '{name}': {nearest(str(name), available(kind))}")
    return CONFIGS / kind / f"{name}.yaml"


def load_yaml(path: Path, cls: type[T], renamed: Mapping[str, str] | None = None) -> T:
    """Load `path` as an instance of the dataclass `cls`. Raises ConfigError naming file, line and key.

    An error about a key that was `renamed` says what it is called now.
    """
    return load_marked(path, cls, renamed)[0]


def load_marked(path: Path, cls: type[T], renamed: Mapping[str, str] | None = None) -> tuple[T, Marks]:
    """Like `load_yaml`, with the lines of the keys, for checks that need more than types. Raises ConfigError."""
    marks = Marks(path)
    try:
        node = _compose(path.read_text(encoding="utf-8"))
    except yaml.MarkedYAMLError as error:
        mark = error.problem_mark or error.context_mark
        line = mark.line + 1 if mark else 1
        raise ConfigError(f"{path}:{line}: not valid YAML: {error.problem or error.context}") from error
    except yaml.reader.ReaderError as error:
        raise ConfigError(f"{path}:1: not valid YAML: {error.reason} at character {error.position}") from error
    except UnicodeDecodeError as error:
        raise ConfigError(f"{path}:1: not UTF-8 text (byte {error.start})") from error
    except RecursionError as error:
        raise ConfigError(f"{path}:1: nested too deeply") from error
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read: {error.strerror}") from error
    if node is None:
        raise ConfigError(f"{path}:1: the file is empty; it needs {', '.join(_required(cls))}")
    return _Reader(marks, renamed or {}).read(node, cls, ""), marks


def _compose(text: str) -> yaml.Node | None:
    """Raises YAMLError, or RecursionError."""
    try:
        node: yaml.Node | None = yaml.compose(text, Loader=YAML_LOADER)
    except yaml.YAMLError:
        return yaml.compose(text, Loader=yaml.SafeLoader)  # again, for its plainer errors
    return node


def from_values(values: Mapping[str, Any], cls: type[T], path: Path) -> T:
    """An instance of the dataclass `cls` from values as JSON has them, which are from the file `path`, such as a log.

    Raises ConfigError naming file and key.
    """
    node = _compose(json.dumps(values))
    assert node is not None
    result: T = _Reader(Marks(path), {}).read(node, cls, "")
    return result


def parse_number(text: str, hint: type[int] | type[float]) -> int | float:
    """A finite number. Raises ValueError saying what was expected, with a hint when a unit was written."""
    try:
        value = int(text, 0) if hint is int else float(text)
    except ValueError:
        kind = "a whole number" if hint is int else "a number"
        if text.lower().lstrip("+-") in (".inf", ".nan"):  # as YAML writes them
            raise ValueError("a finite number") from None
        unit = re.fullmatch(r"[-+]?[\d.]+(?:e[-+]?\d+)?\s*([a-z%°][\w/%°²^]*)", text, re.IGNORECASE)
        if unit:
            kind += f" without the unit '{unit[1]}': units are fixed (m, rad, s, N m, V, degrees C)"
        raise ValueError(kind) from None
    if not math.isfinite(value):
        raise ValueError("a finite number")
    return value


def _required(cls: Any) -> list[str]:
    return [f.name for f in fields(cls) if f.default is MISSING and f.default_factory is MISSING]


def hints_of(cls: Any) -> dict[str, Any]:
    """Types of a dataclass's fields by their names, kept: finding them takes most of the time of a small file."""
    return _hints(cls)


_hints = functools.cache(typing.get_type_hints)


class _Reader:
    """Builds values of the asked type from nodes, noting the line of every key."""

    def __init__(self, marks: Marks, renamed: Mapping[str, str]) -> None:
        self.marks, self._renamed = marks, renamed

    def fail(self, key: str, message: str) -> NoReturn:
        raise self.marks.error(key, message)

    def read(self, node: yaml.Node, hint: Any, key: str) -> Any:
        self.marks.lines.setdefault(key, node.start_mark.line + 1)
        origin, arguments = typing.get_origin(hint), typing.get_args(hint)
        if is_dataclass(hint):
            return self.dataclass(node, hint, key)
        if origin in (types.UnionType, typing.Union):
            return self.union(node, arguments, key)
        if origin is dict:
            items = self.mapping(node, key)
            return {name: self.read(item, arguments[1], _join(key, name)) for name, item in items.items()}
        if origin in (tuple, list):
            return self.sequence(node, origin, arguments, key)
        if hint is Any:
            return yaml.constructor.SafeConstructor().construct_document(node)
        return self.scalar(node, hint, key)

    def dataclass(self, node: yaml.Node, cls: Any, key: str) -> Any:
        items = self.mapping(node, key)
        known = hints_of(cls)
        hints = {f.name: known[f.name] for f in fields(cls) if f.init}
        for name in items:
            if name not in hints:
                new = self._renamed.get(name)
                what = f"this key is called '{new}' now" if new else f"unknown key; {nearest(name, hints)}"
                self.fail(_join(key, name), what)
        missing = [name for name in _required(cls) if name not in items]
        if missing:
            self.fail(key, f"missing key '{missing[0]}' (this part needs {', '.join(_required(cls))})")
        values = {name: self.read(item, hints[name], _join(key, name)) for name, item in items.items()}
        try:
            return cls(**values)
        except ValueError as error:  # the dataclass's own check, which names what is wrong
            words = (_join(key, word) for word in re.findall(r"\w+(?:\.\w+)*", str(error)))
            raise self.marks.error(key, str(error), next((w for w in words if w in self.marks.lines), key)) from error

    def mapping(self, node: yaml.Node, key: str) -> dict[str, yaml.Node]:
        if not isinstance(node, yaml.MappingNode):
            self.fail(key, f"expected keys and values, got {_describe(node)}")
        items: dict[str, yaml.Node] = {}
        for name_node, item in node.value:
            line = name_node.start_mark.line + 1
            name_key = _join(key, str(name_node.value)) if isinstance(name_node, yaml.ScalarNode) else key
            self.marks.lines.setdefault(name_key, line)
            if name_node.tag == "tag:yaml.org,2002:merge":
                self.fail(name_key, "keys of another part cannot be merged in here: write them out")
            name = self.scalar(name_node, str, name_key, "key")
            if name in items:
                first = self.marks.lines[_join(key, name)]
                self.marks.lines[_join(key, name)] = line
                self.fail(_join(key, name), f"duplicate key, first given on line {first}")
            items[name] = item
            self.marks.lines[_join(key, name)] = line
        return items

    def sequence(self, node: yaml.Node, origin: Any, arguments: tuple[Any, ...], key: str) -> Any:
        if not isinstance(node, yaml.SequenceNode):
            self.fail(key, f"expected a list, got {_describe(node)}")
        if origin is tuple and arguments[-1] is not Ellipsis:
            if len(node.value) != len(arguments):
                self.fail(key, f"expected {len(arguments)} values, got {len(node.value)}")
            hints = list(arguments)
        else:
            hints = [arguments[0]] * len(node.value)
        return origin(
            self.read(item, hint, f"{key}[{i}]") for i, (item, hint) in enumerate(zip(node.value, hints, strict=True))
        )

    def union(self, node: yaml.Node, options: tuple[Any, ...], key: str) -> Any:
        if node.tag == "tag:yaml.org,2002:null" and type(None) in options:
            return None
        errors: list[ConfigError] = []
        for option in (o for o in options if o is not type(None)):
            try:
                return self.read(node, option, key)
            except ConfigError as error:
                errors.append(error)
        raise errors[0]

    def scalar(self, node: yaml.Node, hint: Any, key: str, what: str = "value") -> Any:
        expected = getattr(hint, "__name__", str(hint))
        if hint in (str, Path):
            if not isinstance(node, yaml.ScalarNode):
                self.fail(key, f"expected text as {what}, got {_describe(node)}")
            if not node.tag.endswith(":str"):
                quote = "" if node.tag.endswith(":null") else f'; write "{node.value}" if text is meant'
                self.fail(key, f"expected text as {what}, got {_describe(node)}{quote}")
            return hint(node.value)
        if not isinstance(node, yaml.ScalarNode):
            self.fail(key, f"expected {expected}, got {_describe(node)}")
        if hint is bool:
            if not node.tag.endswith(":bool"):
                self.fail(key, f"expected true or false, got {_describe(node)}")
            return node.value.lower() in ("true", "yes", "on")
        if hint in (int, float):
            if node.style in ("'", '"'):
                self.fail(key, f"expected a number, got the text '{node.value}'; take the quotes away")
            try:
                return parse_number(node.value, hint)
            except ValueError as error:
                self.fail(key, f"expected {error}, got {_describe(node)}")
        if typing.get_origin(hint) is typing.Literal:
            options = [str(option) for option in typing.get_args(hint)]
            if node.value not in options or not node.tag.endswith(":str"):
                self.fail(key, f"expected one of {', '.join(options)}, got {_describe(node)}")
            return node.value
        if isinstance(hint, type) and issubclass(hint, enum.Enum):
            if node.value not in hint.__members__:
                self.fail(key, f"unknown {expected} '{node.value}'; {nearest(node.value, hint.__members__)}")
            return hint[node.value]
        raise TypeError(f"configuration classes cannot hold {hint}")


def _join(key: str, name: str) -> str:
    return f"{key}.{name}" if key else name


def _describe(node: yaml.Node) -> str:
    """A node in words, as YAML understands it."""
    if isinstance(node, yaml.MappingNode):
        return "keys and values"
    if isinstance(node, yaml.SequenceNode):
        return f"a list of {len(node.value)}"
    kind = {"int": "the number ", "float": "the number ", "bool": "the boolean ", "timestamp": "the date "}
    name = node.tag.rsplit(":", 1)[-1]
    shown = f"{node.value[:_SHOWN]}..." if len(node.value) > _SHOWN else node.value
    return "nothing" if name == "null" and not node.value else f"{kind.get(name, '')}'{shown}'"

"""Strict YAML into frozen dataclasses: an error names the file, the line and the key."""

from __future__ import annotations

import types
import typing
from dataclasses import fields, is_dataclass
from pathlib import Path
from typing import Any, TypeVar

import yaml

CONFIGS = Path(__file__).resolve().parent.parent / "configs"

T = TypeVar("T")


class ConfigError(Exception):
    """A configuration that cannot be used: exit code 2."""


def resolve(kind: str, name: str | Path) -> Path:
    """Path of a configuration: a file as it is, or `configs/<kind>/<name>.yaml`. Raises ConfigError."""
    path = Path(name)
    if path.suffix in (".yaml", ".yml"):
        return path
    return CONFIGS / kind / f"{name}.yaml"


def load_yaml(path: Path, cls: type[T]) -> T:
    """Load `path` as an instance of the dataclass `cls`. Raises ConfigError."""
    return _build(yaml.safe_load(path.read_text()), cls)


def _build(value: Any, cls: Any) -> Any:
    origin = typing.get_origin(cls)
    if origin is tuple:
        item = typing.get_args(cls)
        return tuple(_build(v, item[0]) for v in value)
    if origin is dict:
        return {k: _build(v, typing.get_args(cls)[1]) for k, v in value.items()}
    if origin in (types.UnionType, typing.Union):
        return value
    if is_dataclass(cls):
        hints = typing.get_type_hints(cls)
        return cls(**{f.name: _build(value[f.name], hints[f.name]) for f in fields(cls) if f.name in value})
    return cls(value)

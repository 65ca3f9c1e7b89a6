"""Classes of a user's own: by entry point of an installed package, or as `FILE.py:Class`.

A file is imported under a name that its path gives, so that no file hides a module, and every process finds it again.
"""

from __future__ import annotations

import ast
import hashlib
import importlib.util
import pickle
import sys
import traceback
from dataclasses import dataclass
from functools import cache
from importlib.metadata import EntryPoint, entry_points
from pathlib import Path
from typing import Any

from servoid.hw.config import ConfigError, nearest


@dataclass(frozen=True)
class Plugin:
    """A class of a user's own, and where it came from."""

    cls: type[Any]
    file: Path
    line: int  # of the class in the file
    package: str | None = None  # the installed package whose entry point names it, with its version

    def error(self, message: str) -> ConfigError:
        """An error in the class, with its file and line."""
        return ConfigError(f"{self.file}:{self.line}: {message}")

    def source(self) -> dict[str, Any]:
        """Where the class came from, for a flight log: file, class, hash of the file and, if installed, the package."""
        content = self.file.read_bytes() if self.file.is_file() else b""
        digest = hashlib.sha256(content).hexdigest()
        return {"file": str(self.file), "class": self.cls.__qualname__, "sha256": digest, "package": self.package}


def is_file_reference(name: str) -> bool:
    """Whether `name` is `FILE.py` or `FILE.py:Class`."""
    return name.endswith(".py") or ".py:" in name


def installed(group: str) -> dict[str, EntryPoint]:
    """Entry points of a group by their names, without importing them."""
    return {point.name: point for point in sorted(entry_points(group=group), key=lambda point: point.name)}


def load_plugin(name: str, group: str, base: type[Any], kind: str) -> Plugin | None:
    """The class that `name` refers to, a subclass of `base`; None where `name` is neither a file's nor an entry point.

    `kind` says what is looked for. Raises ConfigError with the file and the line where it cannot be used.
    """
    if is_file_reference(name):
        path, _, attribute = name.rpartition(":") if ".py:" in name else (name, "", "")
        file = Path(path).expanduser().resolve()
        plugin = _from_file(file, attribute, base, kind)
    else:
        point = installed(group).get(name)
        if point is None:
            return None
        plugin = _from_package(point)
    if not (isinstance(plugin.cls, type) and issubclass(plugin.cls, base)):
        raise plugin.error(f"{name}: not a {kind}: extend {base.__module__}.{base.__qualname__}")
    return plugin


class Portable:
    """Carries an object to another process, where the file that its class comes from is imported first."""

    def __init__(self, value: Any) -> None:
        self.value = value

    def __reduce__(self) -> tuple[Any, ...]:
        return _carried, (_imported_files(), pickle.dumps(self.value))


def _carried(files: tuple[Path, ...], data: bytes) -> Any:
    for file in files:
        import_file(file)
    return pickle.loads(data)


def import_file(file: Path) -> Any:
    """Import a Python file, once in a process. Raises ConfigError naming file and line of what goes wrong in it."""
    name = _module_name(file)
    if name in sys.modules:
        return sys.modules[name]
    if not file.is_file():
        siblings = [path.name for path in file.parent.glob("*.py")] if file.parent.is_dir() else []
        hint = nearest(file.name, siblings) if siblings else f"there is no Python file in {file.parent}"
        raise ConfigError(f"{file}: no such file; {hint}")
    spec = importlib.util.spec_from_file_location(name, file)
    assert spec is not None
    assert spec.loader is not None
    module = importlib.util.module_from_spec(spec)
    sys.modules[name] = module  # dataclasses and pickle look it up there
    if str(file.parent) not in sys.path:
        sys.path.append(str(file.parent))  # it may be one of several; last, so that it hides nothing
    try:
        spec.loader.exec_module(module)
    except (Exception, SystemExit) as error:
        del sys.modules[name]
        raise _failed(file, error) from error
    return module


def _module_name(file: Path) -> str:
    return f"servoid_file_{hashlib.sha256(str(file).encode()).hexdigest()[:16]}"


def _imported_files() -> tuple[Path, ...]:
    modules = [module for name, module in sys.modules.items() if name.startswith("servoid_file_")]
    return tuple(Path(str(module.__file__)) for module in modules)


def _failed(file: Path, error: BaseException) -> ConfigError:
    """What went wrong while `file` was imported, at the last line of it that was reached."""
    if isinstance(error, ConfigError):
        return error
    lines = [frame.lineno for frame in traceback.extract_tb(error.__traceback__) if frame.filename == str(file)]
    line = error.lineno if isinstance(error, SyntaxError) and error.filename == str(file) else (lines or [1])[-1]
    message = error.msg if isinstance(error, SyntaxError) else error
    return ConfigError(f"{file}:{line}: {type(error).__name__}: {message}")


def _from_file(file: Path, attribute: str, base: type[Any], kind: str) -> Plugin:
    module = import_file(file)
    lines = _classes(file)
    if not attribute:
        mine = [name for name in lines if issubclass(vars(module).get(name, object), base)]
        if len(mine) != 1:
            what = f"has {len(mine)} {kind} classes ({', '.join(mine)})" if mine else f"has no {kind} class"
            raise ConfigError(f"{file}:1: {what}: write {file.name}:CLASS")
        attribute = mine[0]
    if attribute not in vars(module):
        raise ConfigError(f"{file}:1: there is no class '{attribute}'; {nearest(attribute, lines)}")
    return Plugin(vars(module)[attribute], file, lines.get(attribute, 1))


def _from_package(point: EntryPoint) -> Plugin:
    """Raises ConfigError where the package's module cannot be imported, or lacks what the entry point names."""
    package = f"{point.dist.name} {point.dist.version}" if point.dist is not None else "an unknown package"
    try:
        cls = point.load()
    except Exception as error:
        frame = (traceback.extract_tb(error.__traceback__) or [None])[-1]
        where = f"{frame.filename}:{frame.lineno}: " if frame is not None else ""
        raise ConfigError(
            f"{where}{type(error).__name__}: {error} (entry point '{point.name} = {point.value}' of {package})"
        ) from error
    file = Path(str(sys.modules[point.module].__file__))
    return Plugin(cls, file, _classes(file).get(point.attr, 1), package)


@cache
def _classes(file: Path) -> dict[str, int]:
    """Names of a file's classes, with their lines."""
    tree = ast.parse(file.read_bytes(), str(file))
    return {node.name: node.lineno for node in tree.body if isinstance(node, ast.ClassDef)}

"""What a run was made of: the header of its flight log."""

from __future__ import annotations

import dataclasses
import hashlib
import platform
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from servoid.hw.contracts.task import Assignment
from servoid.hw.robot.description import Robot
from servoid.policy.checkpoint import git_commit
from servoid.stack.log.format import FORMAT, plain

PACKAGES = ("servoid", "numpy", "mujoco", "torch", "mcap")


def header(
    settings: Any,
    robot: Robot,
    assignment: Assignment,
    source: dict[str, Any] | None,
    body: str,
    policy: dict[str, Any],
) -> dict[str, Any]:
    """Everything that repeating a run needs, and what the repetition is checked against.

    `source` says where a task of a user's own came from. `body` is the backend's name; `policy` holds at least a name.
    Both may be others than the settings say, where a program brought its own.
    """
    return {
        "format": FORMAT,
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "settings": plain(dataclasses.asdict(settings)),
        "seed": settings.seed,
        "task": {"name": assignment.task.name} | described(assignment.task.settings),
        "task_files": files(assignment.task.settings),
        "task_source": source,
        "scene": described(assignment.episode.scene) or None,
        "episode": {name: value for name, value in described(assignment.episode).items() if name != "scene"},
        **fingerprint(robot),
        "backend": body,
        "policy": policy,
        "versions": versions(),
        "git_commit": git_commit(),
    }


def fingerprint(robot: Robot) -> dict[str, Any]:
    """The robot, its servos and its model, to be compared."""
    return {
        "robot": described(robot),
        "servos": {servo.name: described(servo) for servo in robot.servos},
        "mjcf_sha256": sha256(Path(robot.mjcf)),
    }


def versions() -> dict[str, str | None]:
    """Versions of what computes a run."""
    return {name: _version(name) for name in PACKAGES} | {"python": platform.python_version()}


def described(value: Any) -> dict[str, Any]:
    """A dataclass as JSON values; nothing for what is none."""
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return {}
    values: dict[str, Any] = plain(dataclasses.asdict(value))
    return values


def files(settings: Any) -> dict[str, str | None]:
    """Hashes of the files that a task's settings name, such as clips, by their paths; none for what is no dataclass."""
    if not dataclasses.is_dataclass(settings):
        return {}
    values = [getattr(settings, field.name) for field in dataclasses.fields(settings)]
    named = [part for value in values for part in (value if isinstance(value, tuple) else (value,))]
    return {str(path): sha256(path) for path in named if isinstance(path, Path)}


def sha256(path: Path) -> str | None:
    """Hash of a file's bytes; None where there is none."""
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None

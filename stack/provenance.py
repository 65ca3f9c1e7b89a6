"""What a run was made of: the header of its flight log."""

from __future__ import annotations

import dataclasses
import hashlib
import platform
from datetime import UTC, datetime
from importlib.metadata import PackageNotFoundError, version
from pathlib import Path
from typing import Any

from hw.hal import Policy, Task
from hw.robot import Robot
from policy.checkpoint import git_commit
from stack.logformat import FORMAT, plain

PACKAGES = ("servoid", "numpy", "mujoco", "torch", "mcap")


def header(settings: Any, robot: Robot, task: Task, policy: Policy) -> dict[str, Any]:
    """Everything that repeating a run needs, and what the repetition is checked against."""
    return {
        "format": FORMAT,
        "started": datetime.now(UTC).isoformat(timespec="seconds"),
        "settings": plain(dataclasses.asdict(settings)),
        "seed": settings.seed,
        "task": {"name": task.name} | described(getattr(task, "settings", None)),
        **fingerprint(robot, policy),
        "versions": {name: _version(name) for name in PACKAGES} | {"python": platform.python_version()},
        "git_commit": git_commit(),
    }


def fingerprint(robot: Robot, policy: Policy) -> dict[str, Any]:
    """What must be the same for a run to come out the same: the robot, its servos and model, the policy's network."""
    checkpoint = getattr(policy, "checkpoint", None)
    return {
        "robot": described(robot),
        "servos": {servo.name: described(servo) for servo in robot.servos},
        "mjcf_sha256": _sha256(Path(robot.mjcf)),
        "policy": {
            "class": type(policy).__qualname__,
            "checkpoint": None if checkpoint is None else Path(checkpoint).name,
            "checkpoint_sha256": None if checkpoint is None else _sha256(Path(checkpoint)),
        },
    }


def described(value: Any) -> dict[str, Any]:
    """A dataclass as JSON values."""
    if not dataclasses.is_dataclass(value) or isinstance(value, type):
        return {}
    described: dict[str, Any] = plain(dataclasses.asdict(value))
    return described


def _sha256(path: Path) -> str | None:
    return hashlib.sha256(path.read_bytes()).hexdigest() if path.is_file() else None


def _version(package: str) -> str | None:
    try:
        return version(package)
    except PackageNotFoundError:
        return None

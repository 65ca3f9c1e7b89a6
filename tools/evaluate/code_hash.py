"""Hashes of the code and the settings that an episode's record may depend on."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator, Sequence
from functools import cache
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoid.tools.common.cluster.installed import installed

if TYPE_CHECKING:
    from servoid.stack.runtime.run import RunSettings

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("hw", "sim", "policy", "stack")  # checkpoints among them are hashed where they are used
JUDGES = (
    "tools/common/ground_truth.py",
    "tools/common/motion_quality.py",
    "tools/evaluate/judge.py",
    "tools/evaluate/episode.py",
)


@cache
def code() -> str:
    """Hash of the code when the evaluation began: `read_anew` tells whether it is still the same."""
    return digest(ROOT)


def digest(root: Path) -> str:
    """Hash of the names and bytes of the packages' Python files, of configs/, and of what judges a run.

    Evaluations are left out: of what they say, episodes depend on their experiments alone, which are hashed apart.
    """
    total = hashlib.sha256()
    for path in sorted(_files(root)):
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        total.update(f"{path.relative_to(root).as_posix()} {content}\n".encode())
    return total.hexdigest()


def read_anew(robot: str) -> tuple[Any, ...]:
    """What an episode may read from files again, to be compared: hashes of code and configs/, and the robot.

    Nothing is cached. Code is among it because workers and virtual rigs import what they need when they need it. Raises
    ConfigError where the robot's file is no good.
    """
    from servoid.hw.robot.description import load_robot
    from servoid.stack.log.provenance import fingerprint

    return digest(ROOT), fingerprint(load_robot(robot))


def everything_of(runs: Sequence[RunSettings]) -> dict[str, Any]:
    """The same, and what `runs` read: robots, policies with checkpoints, files of tasks. Raises ConfigError."""
    from servoid.hw.robot.description import load_robot
    from servoid.stack.control.policies import policy_fingerprint
    from servoid.stack.log.provenance import files, fingerprint
    from servoid.stack.tasks import load_settings, source

    result = installed()
    for run in runs:
        robot = load_robot(run.robot)
        task = files(load_settings(run.task, dict(run.set), robot)), source(run.task)
        result |= {
            f"robot {run.robot}": fingerprint(robot),
            f"policy {run.policy}": policy_fingerprint(run.policy, robot),
            f"files of task {run.task}": task,
        }
    return result


def _files(root: Path) -> Iterator[Path]:
    for package in PACKAGES:
        yield from (root / package).rglob("*.py")
    configs = root / "configs"
    yield from (path for path in configs.rglob("*") if path.is_file() and configs / "evaluation" not in path.parents)
    yield from (root / name for name in JUDGES)

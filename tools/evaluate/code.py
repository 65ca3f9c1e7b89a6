"""One hash of all the code and settings that an episode's record may depend on."""

from __future__ import annotations

import hashlib
from collections.abc import Iterator
from functools import cache
from pathlib import Path

ROOT = Path(__file__).resolve().parents[2]
PACKAGES = ("hw", "sim", "policy", "stack")  # checkpoints among them are hashed where they are used
JUDGES = ("tools/witness.py", "tools/motion.py", "tools/rollout.py", "tools/evaluate/episode.py")


@cache
def code() -> str:
    """Hash of the code that runs. It is taken once: what is edited while an evaluation runs is not what runs."""
    return digest(ROOT)


def digest(root: Path) -> str:
    """Hash of the names and bytes of the Python files of the packages, all of configs/, and what judges a run."""
    total = hashlib.sha256()
    for path in sorted(_files(root)):
        content = hashlib.sha256(path.read_bytes()).hexdigest()
        total.update(f"{path.relative_to(root).as_posix()} {content}\n".encode())
    return total.hexdigest()


def _files(root: Path) -> Iterator[Path]:
    for package in PACKAGES:
        yield from (root / package).rglob("*.py")
    yield from (path for path in (root / "configs").rglob("*") if path.is_file())
    yield from (root / name for name in JUDGES)

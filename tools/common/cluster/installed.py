"""What is installed on a machine, to be compared with another."""

from __future__ import annotations

import hashlib
from pathlib import Path
from typing import Any

ROOT = Path(__file__).resolve().parents[3]
_FOLDERS = ("hw", "sim", "policy", "stack", "tools", "configs")


def installed() -> dict[str, Any]:
    """By names, what must be the same on each machine that takes part in a piece of work: versions of what computes,
    the code and its settings. Checkpoints are compared where they are used."""
    from servoid.stack.log.provenance import versions

    total = hashlib.sha256()
    for folder in _FOLDERS:
        for path in sorted((ROOT / folder).rglob("*")):
            if path.suffix == ".py" or (folder == "configs" and path.is_file()):
                total.update(
                    f"{path.relative_to(ROOT).as_posix()} {hashlib.sha256(path.read_bytes()).hexdigest()}\n".encode()
                )
    return {f"version of {name}": version for name, version in versions().items()} | {"code": total.hexdigest()}

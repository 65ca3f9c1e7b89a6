"""Checkpoint files: safetensors with a YAML header in their metadata, shared by every network of the project.

The header says what the network was made for, so that one which does not fit the robot is refused with the reason.
Tensors are read as numpy arrays; there is no pickle.
"""

from __future__ import annotations

import subprocess
from collections.abc import Mapping, Sequence
from dataclasses import dataclass
from difflib import get_close_matches
from pathlib import Path
from typing import Any

import numpy as np
import yaml

from servoid.hw.config import YAML_LOADER, ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot

CHECKPOINTS = Path(__file__).resolve().parent / "checkpoints"
FORMAT = 1  # raised when an older program could not read the header any more

# What every header holds besides the keys that a kind of network adds.
REQUIRED = ("format", "kind", "robot", "joints", "rate", "config", "data", "licence", "git_commit", "results")


class CheckpointError(ConfigError):
    """A checkpoint that cannot be used: exit code 2."""


def resolve(name: str | Path, robot: Robot | None = None) -> Path:
    """Path of a checkpoint: a .safetensors file as it is; or, of that name, the robot's own, or else the shipped one.

    Raises CheckpointError.
    """
    path = Path(name)
    if path.suffix != ".safetensors":
        own = None if robot is None else Path(robot.folder) / f"{name}.safetensors"
        path = own if own is not None and own.is_file() else CHECKPOINTS / f"{name}.safetensors"
    if path.is_file():
        return path
    shipped = sorted(p.stem for p in CHECKPOINTS.glob("*.safetensors"))
    near = get_close_matches(path.stem, shipped, n=1, cutoff=0.0)
    hint = f"; did you mean '{near[0]}'?" if near else "; none is shipped: train one, or give the path of a file"
    raise CheckpointError(f"{path}: no such checkpoint{hint}")


@dataclass(frozen=True)
class Origin:
    """What the header of a trained network says of how it came about."""

    data: str  # what it was trained on
    licence: str  # of the data
    results: Mapping[str, Any]  # what was measured
    training: Mapping[str, Any]  # settings


def header(
    kind: str,
    robot: Robot,
    *,
    config: Mapping[str, Any],
    data: str,
    licence: str,
    results: Mapping[str, Any],
    **more: Any,
) -> dict[str, Any]:
    """Header of a network of `kind` trained for `robot`.

    `config` rebuilds the network, `data` says what it was trained on, `licence` is that of the data, `results` what
    was measured; `more` holds the keys of the kind, such as a feature layout.
    """
    return {
        "format": FORMAT,
        "kind": kind,
        "robot": robot.name,
        "joints": list(robot.names),
        "rate": robot.rate,
        "config": dict(config),
        "data": data,
        "licence": licence,
        "git_commit": git_commit(),
        "results": dict(results),
        **more,
    }


def git_commit() -> str:
    """Commit of the source tree, marked when it has local changes; "unknown" outside a git tree."""
    tree = Path(__file__).resolve().parent.parent
    try:
        command = ["git", "describe", "--always", "--abbrev=40", "--dirty"]
        done = subprocess.run(command, cwd=tree, capture_output=True, text=True, timeout=10)
    except (OSError, subprocess.TimeoutExpired):
        return "unknown"
    return done.stdout.strip() or "unknown"


def write(path: Path, tensors: Mapping[str, Array], head: Mapping[str, Any]) -> None:
    """Write a checkpoint; a reader sees the old file or the new one, never a part. Raises CheckpointError."""
    from safetensors.numpy import save

    missing = [key for key in REQUIRED if key not in head]
    if missing:
        raise CheckpointError(f"{path}: the header lacks {', '.join(missing)}")
    check_out(path, head["joints"])
    content = {name: np.ascontiguousarray(value) for name, value in tensors.items()}
    part = path.with_suffix(".part")
    try:
        part.write_bytes(save(content, {"header": yaml.safe_dump(dict(head), sort_keys=False)}))
        part.replace(path)
    except OSError as error:
        raise CheckpointError(f"{path}: cannot write the checkpoint: {error}") from error


def check_out(path: Path, joints: Sequence[str]) -> None:
    """Refuse to write over the checkpoint of a robot with other joints. Raises CheckpointError."""
    if path.is_file() and list(joints) != (known := read_header(path))["joints"]:
        raise CheckpointError(
            f"{path}: is a checkpoint of {known['robot']}, which has other joints: choose another file"
        )


def read_header(path: Path) -> dict[str, Any]:
    """Header of a checkpoint, without its tensors. Raises CheckpointError."""
    return _read(path, tensors=False)[0]


def read(path: Path) -> tuple[dict[str, Any], dict[str, Array]]:
    """Header and tensors of a checkpoint. Raises CheckpointError."""
    return _read(path, tensors=True)


def _read(path: Path, tensors: bool) -> tuple[dict[str, Any], dict[str, Array]]:
    from safetensors import SafetensorError, safe_open

    try:
        with safe_open(path, framework="numpy") as file:
            text = (file.metadata() or {}).get("header")
            arrays = {name: file.get_tensor(name) for name in file.keys()} if tensors else {}  # noqa: SIM118
    except FileNotFoundError as error:
        raise CheckpointError(f"{path}: no such checkpoint") from error
    except (SafetensorError, OSError) as error:
        raise CheckpointError(f"{path}: not a checkpoint, or a truncated one ({error}); copy it again") from error
    if text is None:
        raise CheckpointError(f"{path}: a safetensors file without the header of this project; it comes from elsewhere")
    try:
        head = yaml.load(text, Loader=YAML_LOADER)
    except yaml.YAMLError as error:
        raise CheckpointError(f"{path}: the header is not valid YAML ({error})") from error
    missing = [key for key in REQUIRED if not isinstance(head, dict) or key not in head]
    if missing:
        raise CheckpointError(f"{path}: the header lacks {', '.join(missing)}")
    if head["format"] > FORMAT:
        raise CheckpointError(f"{path}: format {head['format']} is newer than this program's {FORMAT}; update it")
    return head, arrays


def part(tensors: Mapping[str, Array], name: str) -> dict[str, Array]:
    """The tensors `name.*` of a file that holds several networks, without the prefix."""
    return {key.removeprefix(f"{name}."): value for key, value in tensors.items() if key.startswith(f"{name}.")}


def check(path: Path, head: Mapping[str, Any], kind: str, robot: Robot) -> None:
    """Refuse a checkpoint of another kind, joint order or rate. The robot's name may differ. Raises CheckpointError."""
    if head["kind"] != kind:
        raise CheckpointError(f"{path}: holds a {head['kind']} network, but a {kind} network is needed")
    theirs, ours = list(head["joints"]), list(robot.names)
    # The network that a robot of one's own needs first, and what it walks by until it has the others.
    own = Path(robot.folder) / f"{path.stem}.safetensors"
    remedies = {"odometry": f"; train it once: servoid train odometry --policy gait --robot FILE --out {own}"}
    remedies |= dict.fromkeys(("diffusion", "tracker"), "; a robot that has no such network yet goes by --policy gait")
    remedy = remedies.get(kind, "")
    if theirs != ours:
        reason = difference(theirs, ours)
        raise CheckpointError(f"{path}: made for {head['robot']}, its joints do not fit {robot.name}: {reason}{remedy}")
    if head["rate"] != robot.rate:
        raise CheckpointError(
            f"{path}: made for {head['rate']} ticks a second, but {robot.name} runs at {robot.rate}; "
            f"set rate: {head['rate']} in the robot's file or use another checkpoint{remedy}"
        )


def check_layout(path: Path, name: str, theirs: Sequence[Sequence[Any]], ours: Sequence[Sequence[Any]]) -> None:
    """Refuse a checkpoint whose layout `name` (pairs of field and size) is not `ours`. Raises CheckpointError."""
    a, b = ([f"{field}({size})" for field, size in layout] for layout in (theirs, ours))
    if a != b:
        raise CheckpointError(f"{path}: its {name} layout is not this program's: {difference(a, b)}")


def difference(theirs: Sequence[str], ours: Sequence[str]) -> str:
    """What sets names apart that are not the same, or not in the same order."""
    if len(theirs) != len(ours):
        extra = [x for x in theirs if x not in ours]
        lacking = [x for x in ours if x not in theirs]
        text = f"{len(theirs)} entries, {len(ours)} needed"
        text += f"; not known here: {', '.join(extra)}" if extra else ""
        return text + (f"; missing: {', '.join(lacking)}" if lacking else "")
    i = next(i for i, (a, b) in enumerate(zip(theirs, ours, strict=True)) if a != b)
    return f"entry {i} is {theirs[i]}, but {ours[i]} is needed"

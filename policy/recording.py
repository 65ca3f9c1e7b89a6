"""A recorded dataset (LeRobot v3.0 layout), all in memory.

Row i holds the state of tick i, the action decided on it (clean label) and the action that really ran (noisy).
"""

from __future__ import annotations

import json
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.policy.checkpoint import difference
from servoid.policy.features import recorded_names

COLUMNS = ("observation.state", "action", "action_applied", "command", "episode_index", "frame_index")
CLOCK = "clock"  # column of a recording of skills: s since the one that is told began
BOX, PLACE = "box", "goal"  # columns of a recording of carrying: the thing, and where it shall be
BOX_NAMES, PLACE_NAMES = ("x", "y", "z", "qw", "qx", "qy", "qz"), ("x", "y")
SKILLS_NOTE = "skills"  # beside it: their names, in the order of their tasks' numbers, which follow those of walking


class DatasetError(ConfigError):
    """A dataset that cannot be trained on: exit code 2."""


@dataclass(frozen=True)
class Recording:
    """Rows of all episodes, one after the other."""

    raw: Array  # (rows, raw size) float32
    action: Array  # (rows, n_joints) rad, what the expert decided
    applied: Array  # (rows, n_joints) rad, what really ran
    command: Array  # (rows, 3) m/s forward, m/s left, rad/s that were asked
    episode: Array  # (rows,) int
    info: dict[str, Any]  # meta/info.json
    told: Array | None = None  # (rows,) int, number of the task; None: walks alone, told by their commands
    clock: Array | None = None  # (rows,) s since the skill began that is told, 0 of a walk
    box: Array | None = None  # (rows, 7) a thing that is carried, as `Instruction.box` has it,
    place: Array | None = None  # (rows, 2) m and where it shall be, heading frame

    @property
    def skills(self) -> tuple[str, ...]:
        """Names of the skills that are performed: those of tasks that follow the motions of walking."""
        if self.told is None:
            return ()
        return tuple(self.info["features"][CLOCK]["info"][SKILLS_NOTE].split(", "))

    @cached_property
    def spans(self) -> Array:
        """First and one past the last row of each episode, `(episodes, 2)`."""
        starts = np.flatnonzero(np.r_[True, np.diff(self.episode) != 0])
        return np.stack([starts, np.r_[starts[1:], len(self.episode)]], 1)


def read_recording(folder: Path, robot: Robot) -> Recording:
    """Read a dataset folder. Raises DatasetError naming the file and what is wrong with it."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    files = sorted(folder.glob("data/chunk-*/file-*.parquet"))
    if not files:
        raise DatasetError(f"{folder}: no data/chunk-*/file-*.parquet here; record a dataset with `servoid collect`")
    described = folder / "meta" / "info.json"
    try:
        info = json.loads(described.read_text())
    except (OSError, ValueError) as error:
        raise DatasetError(f"{described}: cannot be read ({error})") from error
    if info.get("fps", robot.rate) != robot.rate:
        raise DatasetError(f"{folder}: recorded at {info['fps']} ticks a second, and {robot.name} runs at {robot.rate}")
    names = recorded_names(robot)
    for name, ours in names.items():
        theirs = tuple(info.get("features", {}).get(name, {}).get("names") or ())
        if theirs != ours:
            what = difference(theirs, ours)
            raise DatasetError(
                f"{described}: '{name}' is not that of {robot.name}: {what}; give --robot that of the recording, or "
                "record another one with `servoid collect`"
            )
    sizes = {name: len(ours) for name, ours in names.items()}
    columns_read: tuple[str, ...] = COLUMNS
    if skills := CLOCK in info.get("features", {}):
        sizes[CLOCK], columns_read = 1, (*COLUMNS, CLOCK, "task_index")
    if carries := BOX in info.get("features", {}):
        sizes |= {BOX: len(BOX_NAMES), PLACE: len(PLACE_NAMES)}
        columns_read = (*columns_read, BOX, PLACE)
    parts: dict[str, list[Array]] = {name: [] for name in columns_read}
    for file in files:
        try:
            table = pq.read_table(file)
        except (pa.ArrowInvalid, OSError) as error:
            raise DatasetError(f"{file}: not a parquet file, or a truncated one ({error})") from error
        for name in columns_read:
            if name not in table.column_names:
                raise DatasetError(f"{file}: no column '{name}'; it has {', '.join(table.column_names)}")
            column = table.column(name).combine_chunks()
            if name not in sizes:
                parts[name].append(column.to_numpy(zero_copy_only=False))
                continue
            flat = column.flatten().to_numpy(zero_copy_only=False)
            if flat.size != sizes[name] * table.num_rows:
                raise DatasetError(f"{file}: '{name}' does not have {sizes[name]} numbers a row")
            parts[name].append(flat.reshape(-1, sizes[name]).astype(np.float32))
    columns = {name: np.concatenate(part) for name, part in parts.items()}
    order = np.lexsort((columns["frame_index"], columns["episode_index"]))
    columns = {name: np.ascontiguousarray(value[order]) for name, value in columns.items()}
    for name in sizes:
        bad = np.flatnonzero(~np.isfinite(columns[name]).all(1))
        if bad.size:
            where = f"episode {columns['episode_index'][bad[0]]}, frame {columns['frame_index'][bad[0]]}"
            raise DatasetError(f"{folder}: '{name}' is not finite in {bad.size} rows, first in {where}")
    gaps = (np.diff(columns["episode_index"]) == 0) & (np.diff(columns["frame_index"]) != 1)
    if gaps.any():
        where = np.flatnonzero(gaps)[0]
        episode, frame = columns["episode_index"][where], columns["frame_index"][where]
        raise DatasetError(f"{folder}: episode {episode} does not go on by one after frame {frame}")
    return Recording(
        raw=columns["observation.state"],
        action=columns["action"],
        applied=columns["action_applied"],
        command=columns["command"],
        episode=columns["episode_index"],
        info=info,
        told=columns["task_index"] if skills else None,
        clock=columns[CLOCK][:, 0] if skills else None,
        box=columns[BOX] if carries else None,
        place=columns[PLACE] if carries else None,
    )


def source_of(folder: Path, recording: Recording) -> str:
    """What a run and its checkpoints say that they were trained on."""
    return f"{folder.resolve().name}: {len(recording.spans)} episodes, {len(recording.raw)} ticks"

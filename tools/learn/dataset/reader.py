"""Reads what LeRobot v3.0 datasets say of themselves, and their columns."""

from __future__ import annotations

import json
from collections.abc import Sequence
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array

VERSION = "v3.0"


@dataclass(frozen=True)
class Dataset:
    """A dataset's folder and its metadata."""

    folder: Path
    info: dict[str, Any]
    tasks: tuple[str, ...]  # the texts that `task_index` numbers
    episodes: list[dict[str, Any]]  # rows of meta/episodes, in order

    @property
    def features(self) -> dict[str, dict[str, Any]]:
        found: dict[str, dict[str, Any]] = self.info["features"]
        return found

    @property
    def cameras(self) -> list[str]:
        """Names of the features that are films."""
        return [name for name, feature in self.features.items() if feature.get("dtype") == "video"]

    @property
    def files(self) -> list[Path]:
        """Its parquet files of frames."""
        return sorted(self.folder.glob("data/chunk-*/file-*.parquet"))

    def columns(self, names: Sequence[str], episode: int | None = None) -> dict[str, Array]:
        """Columns by name, `(frames, size)` or `(frames,)`, of one episode or of all. Raises ConfigError."""
        import pyarrow as pa
        import pyarrow.parquet as pq

        parts: dict[str, list[Array]] = {name: [] for name in names}
        for path in self.files:
            try:
                chosen = None if episode is None else [("episode_index", "=", episode)]
                table = pq.read_table(path, columns=list(names), filters=chosen)
            except (pa.ArrowInvalid, OSError) as error:
                raise ConfigError(f"{path}: not a parquet file of a dataset, or a truncated one ({error})") from None
            for name in names:
                if name not in table.column_names:
                    raise ConfigError(f"{path}: no column '{name}', though {self.folder}/meta/info.json names it")
                parts[name].append(_array(table.column(name).combine_chunks()))
        return {name: np.concatenate(part) for name, part in parts.items()}


def read_dataset(folder: Path) -> Dataset:
    """Raises ConfigError naming the file that is missing, or is not as the format has it."""
    import pyarrow as pa
    import pyarrow.parquet as pq

    path = folder / "meta" / "info.json"
    try:
        info = json.loads(path.read_text(encoding="utf-8"))
        version = str(info["codebase_version"])
        _ = info["features"], info["fps"], info["robot_type"], info["total_episodes"]
    except FileNotFoundError:
        raise ConfigError(f"{folder}: not a LeRobot dataset: it has no meta/info.json") from None
    except (OSError, ValueError, KeyError, TypeError) as error:
        raise ConfigError(f"{path}: not the description of a LeRobot dataset ({error!r})") from None
    if version != VERSION:
        raise ConfigError(
            f"{path}: of format {version}, and only {VERSION} is read: convert it with LeRobot's own tools"
        )
    try:
        tasks = pq.read_table(folder / "meta" / "tasks.parquet").to_pylist()
        texts = [row.get("task", row.get("__index_level_0__")) for row in sorted(tasks, key=lambda r: r["task_index"])]
        rows = [
            row for path in sorted(folder.glob("meta/episodes/*/*.parquet")) for row in pq.read_table(path).to_pylist()
        ]
        rows.sort(key=lambda row: row["episode_index"])
    except (pa.ArrowInvalid, OSError, KeyError) as error:
        raise ConfigError(f"{folder}/meta: not that of a LeRobot dataset ({error})") from None
    if len(rows) != info["total_episodes"]:
        raise ConfigError(f"{folder}/meta: has {len(rows)} episodes, and info.json says {info['total_episodes']}")
    return Dataset(folder, info, tuple(map(str, texts)), rows)


def _array(column: Any) -> Array:
    import pyarrow as pa

    if not (pa.types.is_fixed_size_list(column.type) or pa.types.is_list(column.type)):
        return np.asarray(column.to_numpy(zero_copy_only=False))
    flat = column.flatten().to_numpy(zero_copy_only=False)
    return np.asarray(flat).reshape(len(column), -1)

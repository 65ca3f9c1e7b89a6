"""Writes LeRobot v3.0 datasets without cameras: many episodes a parquet file, found again through tables of metadata.

    meta/info.json                             schema, counts, path templates
    meta/stats.json                            minimum, maximum, mean, deviation and count of every feature
    meta/tasks.parquet                         texts and their numbers
    meta/episodes/chunk-000/file-000.parquet   one row an episode: length, tasks, where it lies, its own statistics
    data/chunk-000/file-000.parquet            one row a frame, one row group an episode

A dataset appears under its name when it is whole: until then it grows in a `.part` folder beside it. Rows go to disk
as episodes come, and hold nothing of the day or the machine: the same episodes make the same files.
"""

from __future__ import annotations

import json
import math
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import dataclass
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array

VERSION = "v3.0"
DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
FILES_A_CHUNK = 1000
FILE_MEGABYTES = 100
_VIDEO_FILE_MEGABYTES = 200  # no video is written, but the format's own tools look for the key

# Columns that the format asks for beside the features; all scalars.
_INDEX = {
    "timestamp": "float32",  # s from the start of the episode
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",  # over the whole dataset
    "task_index": "int64",
}
_STATISTICS = ("min", "max", "mean", "std", "count")


@dataclass(frozen=True)
class Feature:
    """A float32 vector recorded every frame: the names of its numbers, and notes for the reader."""

    names: tuple[str, ...]
    info: Mapping[str, str] | None = None


@dataclass(frozen=True)
class Schema:
    """What a dataset holds."""

    robot_type: str
    fps: int  # rows a second
    features: Mapping[str, Feature]  # by column name
    tasks: tuple[str, ...]  # the texts that `task_index` numbers


def check_target(out: Path, force: bool) -> None:
    """Refuse a folder that may not be written. Raises ConfigError.

    `force` allows to replace a dataset; a folder with anything else in it is never replaced.
    """
    if out.name in ("", ".."):
        raise ConfigError(f"{out}: not a name for a dataset; name a folder to create, such as runs/walks")
    if out.is_dir() and any(out.iterdir()):
        if not (out / "meta" / "info.json").is_file():
            raise ConfigError(f"{out}: holds something other than a dataset; choose another folder")
        if not force:
            raise ConfigError(f"{out}: already holds a dataset; choose another folder, or replace it with --force")
    elif out.exists() and not out.is_dir():
        raise ConfigError(f"{out}: is a file; name a folder to create")
    part = _part(out)
    if part.exists() and not (part.is_dir() and {p.name for p in part.iterdir()} <= {"data", "meta"}):
        raise ConfigError(f"{part}: is where the unfinished dataset would go; move it, or choose another folder")


def _part(out: Path) -> Path:
    return out.with_name(out.name + ".part")


class DatasetWriter:
    """A dataset being written to `out`; as a context manager, it leaves nothing behind when the block raises.

    Every method raises ConfigError when the disk does not take what is written.
    """

    def __init__(self, out: Path, schema: Schema, force: bool = False) -> None:
        check_target(out, force)
        self.out, self._part, self.schema = out, _part(out), schema
        self.episodes = 0
        self.frames = 0
        self._file = -1  # number of the newest data file
        self._file_bytes = math.inf  # in it; a new one is due
        self._writer: Any = None
        self._rows: list[dict[str, Any]] = []  # of meta/episodes
        self._total: dict[str, dict[str, Array]] = {}
        with self._writing():
            shutil.rmtree(self._part, ignore_errors=True)  # of a run that was killed
            (self._part / "meta").mkdir(parents=True)

    def __enter__(self) -> DatasetWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if error is not None:
            self._abandon()

    def add(self, columns: Mapping[str, Array], task_index: Array) -> None:
        """Append an episode: a `(frames, size)` array for each feature, and the number of each frame's task."""
        frames = len(task_index)
        for name, feature in self.schema.features.items():
            if columns[name].shape != (frames, len(feature.names)):
                raise ValueError(f"'{name}' is {columns[name].shape}, not {(frames, len(feature.names))}")
        whole: dict[str, Array] = {name: columns[name].astype(np.float32) for name in self.schema.features}
        whole["timestamp"] = (np.arange(frames) / self.schema.fps).astype(np.float32)
        whole["frame_index"] = np.arange(frames)
        whole["episode_index"] = np.full(frames, self.episodes)
        whole["index"] = self.frames + np.arange(frames)
        whole["task_index"] = np.asarray(task_index, np.int64)
        with self._writing():
            self._write_rows(whole)
        statistics = {name: _statistics(values) for name, values in whole.items()}
        self._total = {
            name: _merge(self._total[name], part) if name in self._total else part for name, part in statistics.items()
        }
        chunk, file = divmod(self._file, FILES_A_CHUNK)
        order = list(dict.fromkeys(whole["task_index"].tolist()))
        row: dict[str, Any] = {
            "episode_index": self.episodes,
            "tasks": [self.schema.tasks[i] for i in order],
            "length": frames,
            "data/chunk_index": chunk,
            "data/file_index": file,
            "dataset_from_index": self.frames,
            "dataset_to_index": self.frames + frames,
        }
        for name, part in statistics.items():
            row |= {f"stats/{name}/{key}": part[key].tolist() for key in _STATISTICS}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        self._rows.append(row)
        self.episodes += 1
        self.frames += frames

    def finish(self, extra: Mapping[str, str] | None = None) -> None:
        """Write the metadata, with the text files `extra` beside it in meta/, and give the dataset its name."""
        if not self.episodes:
            raise ConfigError(f"{self.out}: no episode was kept, so there is no dataset to write")
        with self._writing():
            self._close()
            self._write_metadata(extra or {})
            self._publish()

    # -- parts -----------------------------------------------------------------------------------------------------

    def _write_rows(self, whole: Mapping[str, Array]) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        table = pa.table({name: _column(values) for name, values in whole.items()})
        if self._file_bytes + table.nbytes > FILE_MEGABYTES * 2**20:
            self._close()
            self._file += 1
            self._file_bytes = 0
            chunk, file = divmod(self._file, FILES_A_CHUNK)
            path = self._part / DATA_PATH.format(chunk_index=chunk, file_index=file)
            path.parent.mkdir(parents=True, exist_ok=True)
            self._writer = pq.ParquetWriter(path, table.schema)
        self._writer.write_table(table)
        self._file_bytes += table.nbytes

    def _write_metadata(self, extra: Mapping[str, str]) -> None:
        import pyarrow as pa
        import pyarrow.parquet as pq

        meta = self._part / "meta"
        (meta / "info.json").write_text(json.dumps(self._info(), indent=4) + "\n")
        statistics = {name: {key: total[key].tolist() for key in _STATISTICS} for name, total in self._total.items()}
        (meta / "stats.json").write_text(json.dumps(statistics, indent=4) + "\n")
        pq.write_table(_tasks_table(self.schema.tasks), meta / "tasks.parquet")
        path = self._part / EPISODES_PATH.format(chunk_index=0, file_index=0)
        path.parent.mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(self._rows), path)
        for name, text in extra.items():
            (meta / name).write_text(text, encoding="utf-8")

    def _info(self) -> dict[str, Any]:
        features: dict[str, Any] = {}
        for name, feature in self.schema.features.items():
            features[name] = {"dtype": "float32", "shape": [len(feature.names)], "names": list(feature.names)}
            if feature.info:
                features[name]["info"] = dict(feature.info)
        features |= {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in _INDEX.items()}
        return {
            "codebase_version": VERSION,
            "robot_type": self.schema.robot_type,
            "total_episodes": self.episodes,
            "total_frames": self.frames,
            "total_tasks": len(self.schema.tasks),
            "chunks_size": FILES_A_CHUNK,
            "data_files_size_in_mb": FILE_MEGABYTES,
            "video_files_size_in_mb": _VIDEO_FILE_MEGABYTES,
            "fps": self.schema.fps,
            "splits": {"train": f"0:{self.episodes}"},
            "data_path": DATA_PATH,
            "video_path": None,
            "features": features,
        }

    def _publish(self) -> None:
        """Give the folder its name; a dataset that was there waits inside the new one until that has its place."""
        old = "replaced"
        if self.out.exists():
            self.out.rename(self._part / old)
        self._part.rename(self.out)
        if (self.out / old).exists():
            shutil.rmtree(self.out / old)

    def _close(self) -> None:
        if self._writer is not None:
            writer, self._writer = self._writer, None
            writer.close()

    def _abandon(self) -> None:
        try:
            self._close()
        except OSError:  # the disk that is full again: what matters is to free it
            self._writer = None
        shutil.rmtree(self._part, ignore_errors=True)

    @contextmanager
    def _writing(self) -> Iterator[None]:
        try:
            yield
        except OSError as error:
            self._abandon()
            reason = error.strerror or str(error)
            raise ConfigError(
                f"{self.out}: the dataset cannot be written: {reason}; nothing was kept: make room or choose another "
                "folder, and start again with the same seed"
            ) from error


def _column(values: Array) -> Any:
    import pyarrow as pa

    if values.ndim == 1:
        return pa.array(values)
    return pa.FixedSizeListArray.from_arrays(pa.array(values.ravel()), values.shape[1])


def _tasks_table(tasks: Sequence[str]) -> Any:
    """Texts as the index of a pandas table, since that is how the format's reader looks a task up."""
    import pyarrow as pa

    def described(name: str, kind: str, numpy_type: str) -> dict[str, Any]:
        return {"name": name, "field_name": name, "pandas_type": kind, "numpy_type": numpy_type, "metadata": None}

    pandas = {
        "index_columns": ["task"],
        "column_indexes": [
            {
                "name": None,
                "field_name": None,
                "pandas_type": "unicode",
                "numpy_type": "object",
                "metadata": {"encoding": "UTF-8"},
            }
        ],
        "columns": [described("task_index", "int64", "int64"), described("task", "unicode", "object")],
        "creator": {"library": "pyarrow", "version": pa.__version__},
        "pandas_version": "2.2.0",  # whose layout this is
    }
    table = pa.table({"task_index": pa.array(range(len(tasks)), pa.int64()), "task": pa.array(tasks, pa.string())})
    return table.replace_schema_metadata({"pandas": json.dumps(pandas)})


def _statistics(values: Array) -> dict[str, Array]:
    """Of `(frames, size)` or `(frames,)`: each `(size,)` or `(1,)`, and the count `(1,)`."""
    rows = values.reshape(len(values), -1)
    return {
        "min": rows.min(0),
        "max": rows.max(0),
        "mean": rows.mean(0, dtype=np.float64),
        "std": rows.std(0, dtype=np.float64),
        "count": np.array([len(rows)]),
    }


def _merge(a: Mapping[str, Array], b: Mapping[str, Array]) -> dict[str, Array]:
    """Statistics of two sets of frames together (the parallel form of the variance)."""
    count = a["count"] + b["count"]
    step = b["mean"] - a["mean"]
    mean = a["mean"] + step * b["count"] / count
    spread = a["std"] ** 2 * a["count"] + b["std"] ** 2 * b["count"] + step**2 * a["count"] * b["count"] / count
    return {
        "min": np.minimum(a["min"], b["min"]),
        "max": np.maximum(a["max"], b["max"]),
        "mean": mean,
        "std": np.sqrt(spread / count),
        "count": count,
    }

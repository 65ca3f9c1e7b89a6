"""Writes LeRobot v3.0 datasets: many episodes a parquet file, found again through tables of metadata.

    meta/info.json                             schema, counts, path templates
    meta/stats.json                            minimum, maximum, mean, deviation, count and quantiles of each feature
    meta/tasks.parquet                         texts and their numbers
    meta/episodes/chunk-000/file-000.parquet   one row an episode: length, tasks, where it lies, its own statistics
    data/chunk-000/file-000.parquet            one row a frame, one row group an episode
    videos/CAMERA/chunk-000/file-000.mp4       the film of an episode

A dataset appears under its name when it is whole: until then it grows in a `.part` folder beside it; one that is
appended to is linked there. Rows go to disk as episodes come, and hold nothing of the day or the machine:
the same episodes make the same files.
"""

from __future__ import annotations

import json
import math
import os
import shutil
from collections.abc import Iterator, Mapping, Sequence
from contextlib import contextmanager
from dataclasses import replace
from pathlib import Path
from types import TracebackType
from typing import Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.tools.learn.dataset.reader import VERSION, Dataset, read_dataset
from servoid.tools.learn.dataset.schema import INDEX, DatasetFilm, Schema, check_same_kind, info_features
from servoid.tools.learn.dataset.statistics import KEYS, Statistics, statistics, together

DATA_PATH = "data/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
VIDEO_PATH = "videos/{video_key}/chunk-{chunk_index:03d}/file-{file_index:03d}.mp4"
EPISODES_PATH = "meta/episodes/chunk-{chunk_index:03d}/file-{file_index:03d}.parquet"
FILES_A_CHUNK = 1000
FILE_MEGABYTES = 100
_VIDEO_FILE_MEGABYTES = 200  # the format's own tools look for the key; here each episode has a file


def check_target(out: Path, force: bool, append: bool = False) -> None:
    """Refuse a folder that may not be written. Raises ConfigError.

    `force` allows to replace a dataset, `append` to add to one; a folder with anything else in it is never replaced.
    """
    if out.name in ("", ".."):
        raise ConfigError(f"{out}: not a name for a dataset; name a folder to create, such as runs/walks")
    if out.is_dir() and any(out.iterdir()):
        if not (out / "meta" / "info.json").is_file():
            raise ConfigError(f"{out}: holds something other than a dataset; choose another folder")
        if not force and not append:
            raise ConfigError(
                f"{out}: already holds a dataset; choose another folder, add to it with --append, or replace it with "
                "--force"
            )
    elif out.exists() and not out.is_dir():
        raise ConfigError(f"{out}: is a file; name a folder to create")
    part = _part(out)
    if part.exists() and not (part.is_dir() and {p.name for p in part.iterdir()} <= {"data", "meta", "videos"}):
        raise ConfigError(f"{part}: is where the unfinished dataset would go; move it, or choose another folder")


def _part(out: Path) -> Path:
    return out.with_name(out.name + ".part")


class DatasetWriter:
    """A dataset being written to `out`; as a context manager, it leaves nothing behind when the block raises.

    Every method raises ConfigError when the disk does not take what is written.
    """

    def __init__(self, out: Path, schema: Schema, force: bool = False, append: bool = False) -> None:
        """`append` adds to the dataset in `out`, where there is one. Raises ConfigError where that is another kind."""
        check_target(out, force, append)
        self.out, self._part, self.schema = out, _part(out), schema
        self.episodes = 0
        self.frames = 0
        self._file = -1  # number of the newest data file
        self._file_bytes = math.inf  # in it; a new one is due
        self._writer: Any = None
        self._rows: list[dict[str, Any]] = []  # of meta/episodes
        self._numbers = list(range(len(schema.tasks)))  # that the schema's tasks have here
        before = read_dataset(out) if append and out.is_dir() and any(out.iterdir()) else None
        if before is not None:
            check_same_kind(before, info_features(schema), schema)
        with self._writing():
            shutil.rmtree(self._part, ignore_errors=True)  # of a run that was killed
            (self._part / "meta").mkdir(parents=True)
            if before is not None:
                self._go_on_from(before)

    def _go_on_from(self, before: Dataset) -> None:
        for path in sorted((*before.files, *self.out.glob("videos/*/chunk-*/file-*.mp4"))):
            linked = self._part / path.relative_to(self.out)
            linked.parent.mkdir(parents=True, exist_ok=True)
            try:
                os.link(path, linked)
            except OSError:  # a file system without links
                shutil.copy2(path, linked)
        tasks = list(dict.fromkeys((*before.tasks, *self.schema.tasks)))
        self._numbers = [tasks.index(text) for text in self.schema.tasks]
        self.schema = replace(self.schema, tasks=tuple(tasks))
        self._rows = before.episodes
        self.episodes, self.frames = len(before.episodes), int(before.info["total_frames"])
        self._file = max(row["data/chunk_index"] * FILES_A_CHUNK + row["data/file_index"] for row in before.episodes)

    def __enter__(self) -> DatasetWriter:
        return self

    def __exit__(self, kind: type[BaseException] | None, error: BaseException | None, at: TracebackType | None) -> None:
        if error is not None:
            self._abandon()

    def add(
        self, columns: Mapping[str, Array], task_index: Array, films: Mapping[str, DatasetFilm] | None = None
    ) -> None:
        """Append an episode: a `(frames, size)` array for each feature, the number of each frame's task, and a film of
        as many frames for each camera."""
        frames = len(task_index)
        for name, feature in self.schema.features.items():
            if columns[name].shape != (frames, len(feature.names)):
                raise ValueError(f"'{name}' is {columns[name].shape}, not {(frames, len(feature.names))}")
        whole: dict[str, Array] = {name: columns[name].astype(np.float32) for name in self.schema.features}
        whole["timestamp"] = (np.arange(frames) / self.schema.fps).astype(np.float32)
        whole["frame_index"] = np.arange(frames)
        whole["episode_index"] = np.full(frames, self.episodes)
        whole["index"] = self.frames + np.arange(frames)
        whole["task_index"] = np.asarray(self._numbers, np.int64)[np.asarray(task_index, np.int64)]
        with self._writing():
            self._write_rows(whole)
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
        found = {name: statistics(values) for name, values in whole.items()}
        for name in self.schema.cameras:
            film = (films or {})[name]
            row |= self._take(film, name, frames)
            found[name] = film.statistics
        for name, part in found.items():
            row |= {f"stats/{name}/{key}": part[key].tolist() for key in KEYS}
        row |= {"meta/episodes/chunk_index": 0, "meta/episodes/file_index": 0}
        self._rows.append(row)
        self.episodes += 1
        self.frames += frames

    def _take(self, film: DatasetFilm, camera: str, frames: int) -> dict[str, Any]:
        chunk, file = divmod(self.episodes, FILES_A_CHUNK)
        path = self._part / VIDEO_PATH.format(video_key=camera, chunk_index=chunk, file_index=file)
        with self._writing():
            path.parent.mkdir(parents=True, exist_ok=True)
            shutil.move(film.path, path)
        return {
            f"videos/{camera}/chunk_index": chunk,
            f"videos/{camera}/file_index": file,
            f"videos/{camera}/from_timestamp": 0.0,
            f"videos/{camera}/to_timestamp": frames / self.schema.fps,
        }

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
        info = self._info()
        (meta / "info.json").write_text(json.dumps(info, indent=4) + "\n")
        pq.write_table(_tasks_table(self.schema.tasks), meta / "tasks.parquet")
        total = self._statistics(Dataset(self._part, info, self.schema.tasks, self._rows))
        plain = {name: {key: part[key].tolist() for key in KEYS} for name, part in total.items()}
        (meta / "stats.json").write_text(json.dumps(plain, indent=4) + "\n")
        path = self._part / EPISODES_PATH.format(chunk_index=0, file_index=0)
        path.parent.mkdir(parents=True)
        pq.write_table(pa.Table.from_pylist(self._rows), path)
        for name, text in extra.items():
            (meta / name).write_text(text, encoding="utf-8")

    def _statistics(self, written: Dataset) -> dict[str, Statistics]:
        """Of all frames, read again a column at a time: quantiles of a whole do not follow from those of its parts."""
        found = {name: statistics(written.columns([name])[name]) for name in (*self.schema.features, *INDEX)}
        for name in self.schema.cameras:
            parts = [{key: np.asarray(row[f"stats/{name}/{key}"]) for key in KEYS} for row in self._rows]
            found[name] = together(parts)
        return found

    def _info(self) -> dict[str, Any]:
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
            "video_path": VIDEO_PATH if self.schema.cameras else None,
            "features": info_features(self.schema),
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

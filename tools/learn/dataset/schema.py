"""What a dataset holds, as its meta/info.json says it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from pathlib import Path
from typing import Any

from servoid.hw.config import ConfigError
from servoid.tools.learn.dataset.reader import Dataset
from servoid.tools.learn.dataset.statistics import KEYS, Statistics

# Columns that the format asks for beside the features; all scalars.
INDEX = {
    "timestamp": "float32",  # s from the start of the episode
    "frame_index": "int64",
    "episode_index": "int64",
    "index": "int64",  # over the whole dataset
    "task_index": "int64",
}


@dataclass(frozen=True)
class Feature:
    """A float32 vector recorded every frame: the names of its numbers, and notes for the reader."""

    names: tuple[str, ...]
    info: Mapping[str, str] | None = None


@dataclass(frozen=True)
class DatasetFilm:
    """What a camera saw of an episode: a file of H.264 that is moved into the dataset."""

    path: Path
    statistics: Statistics  # of its pictures, `statistics.of_pictures`


@dataclass(frozen=True)
class Schema:
    """What a dataset holds."""

    robot_type: str
    fps: int  # rows a second
    features: Mapping[str, Feature]  # by column name
    tasks: tuple[str, ...]  # the texts that `task_index` numbers
    cameras: Mapping[str, tuple[int, int]] = field(default_factory=dict)  # height and width by feature's name


def info_features(schema: Schema) -> dict[str, Any]:
    """Features as meta/info.json has them."""
    features: dict[str, Any] = {}
    for name, feature in schema.features.items():
        features[name] = {"dtype": "float32", "shape": [len(feature.names)], "names": list(feature.names)}
        if feature.info:
            features[name]["info"] = dict(feature.info)
    for name, (height, width) in schema.cameras.items():
        features[name] = {
            "dtype": "video",
            "shape": [height, width, 3],
            "names": ["height", "width", "channels"],
            "info": {
                "video.height": height,
                "video.width": width,
                "video.codec": "h264",
                "video.pix_fmt": "yuv420p",
                "video.is_depth_map": False,
                "video.fps": schema.fps,
                "video.channels": 3,
                "has_audio": False,
            },
        }
    return features | {name: {"dtype": dtype, "shape": [1], "names": None} for name, dtype in INDEX.items()}


def check_same_kind(before: Dataset, features: Mapping[str, Any], schema: Schema) -> None:
    """Raise ConfigError where episodes of the schema do not belong in a dataset."""
    where = f"{before.folder}: cannot be appended to:"
    for what, theirs, ours in (
        ("robot", before.info["robot_type"], schema.robot_type),
        ("rate", before.info["fps"], schema.fps),
    ):
        if theirs != ours:
            raise ConfigError(f"{where} its {what} is {theirs}, and the new episodes' is {ours}")
    for name in {**before.features, **features}:
        old, new = before.features.get(name), features.get(name)
        if old is None or new is None:
            lacking = "it has" if old is None else "the new episodes have"
            raise ConfigError(f"{where} {lacking} no '{name}'")
        if any(old.get(key) != new.get(key) for key in ("dtype", "shape", "names")):
            raise ConfigError(f"{where} its '{name}' has other numbers than that of the new episodes")
    if any(f"stats/{name}/{key}" not in row for row in before.episodes for name in features for key in KEYS):
        raise ConfigError(f"{where} its episodes have no quantiles: it was recorded by an older version")

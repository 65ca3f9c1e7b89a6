"""Show what a LeRobot v3.0 dataset holds: robot, rate, episodes, tasks, and each column with its quantiles."""

from __future__ import annotations

import argparse
import json
from pathlib import Path
from typing import Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.tools.common.exit_codes import DONE
from servoid.tools.common.output import add_json_argument, reporting

_SHOWN = ("min", "q01", "q50", "q99", "max")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("dataset", type=Path, metavar="DIR", help="folder of the dataset")
    parser.add_argument("--episode", type=int, metavar="N", help="this episode instead of all")
    parser.add_argument("--column", metavar="NAME", help="each number of this column, with its name")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Raises ConfigError."""
    from servoid.hw.config import nearest
    from servoid.tools.learn.dataset.reader import read_dataset

    with reporting(args.json) as report:
        dataset = read_dataset(args.dataset)
        info = dataset.info
        if args.episode is not None and not 0 <= args.episode < len(dataset.episodes):
            raise ConfigError(f"--episode {args.episode}: the dataset has episodes 0 to {len(dataset.episodes) - 1}")
        if args.column is not None and args.column not in dataset.features:
            raise ConfigError(f"--column {args.column}: {nearest(args.column, dataset.features)}")
        chosen = dataset.episodes if args.episode is None else [dataset.episodes[args.episode]]
        frames = [row["length"] for row in chosen]
        seconds = sum(frames) / info["fps"]
        tasks: dict[str, int] = {}
        for row in chosen:
            for text in row["tasks"]:
                tasks[text] = tasks.get(text, 0) + 1
        ordered = sorted(tasks, key=lambda text: tasks[text], reverse=True)
        report.line(f"{args.dataset}: {info['robot_type']}, {info['fps']} frames/s, LeRobot {info['codebase_version']}")
        which = (
            f"{len(chosen)} episode{'s' * (len(chosen) != 1)}" if args.episode is None else f"episode {args.episode}"
        )
        report.line(f"{which}: {sum(frames)} frames, {seconds:.1f} s; {min(frames)} to {max(frames)} frames each")
        report.table(("task", "episodes"), [(text, tasks[text]) for text in ordered])
        statistics = _statistics(args.dataset, chosen[0] if args.episode is not None else None, dataset.features)
        report.line()
        if args.column is None:
            rows = [(name, *_whole(feature, statistics.get(name))) for name, feature in dataset.features.items()]
            report.table(("column", "kind", "numbers", *_SHOWN), rows)
        else:
            report.table((args.column, *_SHOWN), _each(dataset.features[args.column], statistics.get(args.column)))
        lacking = [name for name in dataset.features if "q50" not in (statistics.get(name) or {})]
        if lacking:
            report.line(f"without quantiles: {', '.join(lacking)}")
        report.result(
            {
                "robot": info["robot_type"],
                "fps": info["fps"],
                "episodes": len(chosen),
                "frames": sum(frames),
                "seconds": seconds,
                "tasks": tasks,
                "cameras": dataset.cameras,
                "statistics": statistics,
            }
        )
    return DONE


def _statistics(folder: Path, episode: dict[str, Any] | None, features: dict[str, Any]) -> dict[str, dict[str, Any]]:
    """Those of meta/stats.json, or of an episode. Raises ConfigError."""
    if episode is not None:
        parts = (key.removeprefix("stats/").rpartition("/") for key in episode if key.startswith("stats/"))
        found: dict[str, dict[str, Any]] = {name: {} for name in features}
        for name, _, key in parts:
            found.setdefault(name, {})[key] = episode[f"stats/{name}/{key}"]
        return found
    path = folder / "meta" / "stats.json"
    try:
        return dict(json.loads(path.read_text(encoding="utf-8")))
    except (OSError, ValueError) as error:
        raise ConfigError(f"{path}: cannot be read ({error}): LeRobot's own tools calculate it anew") from None


def _whole(feature: dict[str, Any], found: dict[str, Any] | None) -> tuple[str, ...]:
    """Kind and size of a column, and the least or greatest of its numbers' statistics."""
    pick: dict[str, Any] = {"min": np.min, "q01": np.min, "q50": np.median, "q99": np.max, "max": np.max}
    values = (f"{pick[key](found[key]):.4g}" if found and key in found else "-" for key in _SHOWN)
    return feature["dtype"], "x".join(map(str, feature["shape"])), *values


def _each(feature: dict[str, Any], found: dict[str, Any] | None) -> list[tuple[str, ...]]:
    names = feature.get("names") or ["value"]
    columns = {key: np.ravel(found[key]) if found and key in found else None for key in _SHOWN}
    return [
        (str(name), *("-" if column is None else f"{column[i]:.4g}" for column in columns.values()))
        for i, name in enumerate(names)
    ]

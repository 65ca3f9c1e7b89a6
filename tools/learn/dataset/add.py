"""Make a LeRobot v3.0 dataset of flight logs, or add to one: runs, and what people steered.

Each log's task becomes an episode, or several where ticks were missed. The columns are those of `servoid collect`, so
that `servoid train` reads them, and a dataset of either kind takes episodes of the other. A tick's task is the sentence
or the skill that was asked for, else the name of the log's task, or --task. --film draws the run as a camera of the
dataset. Logs that are in the dataset already are left out, so the same command continues.
"""

from __future__ import annotations

import argparse
import tempfile
from collections.abc import Sequence
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.tools.common.exit_codes import DONE
from servoid.tools.common.folder_lock import locked
from servoid.tools.common.output import Report, add_json_argument, reporting

if TYPE_CHECKING:
    from servoid.hw.robot.description import Robot
    from servoid.stack.log.flightlog import FlightLog

SIZE = "320x240"
SOURCES = "servoid.yaml"  # in meta/: where episodes come from


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "out", type=Path, metavar="DIR", help="folder of the dataset, which is made where there is none"
    )
    parser.add_argument("log", type=Path, nargs="+", metavar="LOG", help="flight log (.mcap)")
    parser.add_argument("--task", metavar="TEXT", help="what the robot does in them (default: the task's name)")
    parser.add_argument("--licence", metavar="TEXT", help="licence of a new dataset, such as Apache-2.0")
    parser.add_argument("--film", action="store_true", help="film each episode, a picture a tick, as a camera")
    parser.add_argument("--film-size", default=SIZE, metavar="WxH", help="size of the film (default: %(default)s)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Raises ConfigError."""
    from servoid.stack.log.flightlog import read_log
    from servoid.tools.common.pictures.drawing import film_size

    with reporting(args.json) as report:
        size = film_size(args.film_size, "--film-size")
        logs = [read_log(path) for path in args.log]
        if args.film:
            from servoid.tools.common.pictures.drawing import choose_filming

            choose_filming("--film")
        with locked(args.out):
            result = _add(args, logs, size, report)
        report.result(result)
    return DONE


def _add(args: argparse.Namespace, logs: Sequence[FlightLog], size: tuple[int, int], report: Report) -> dict[str, Any]:
    import yaml

    from servoid.stack.log.provenance import sha256
    from servoid.tools.learn.dataset.from_log import episodes_of, robot_of, schema_of
    from servoid.tools.learn.dataset.lerobot import DatasetWriter

    about = _about(args)
    known = {source["sha256"] for source in about["logs"]}
    robot: Robot | None = None
    episodes = []
    for log in logs:
        digest, its = sha256(log.path), robot_of(log)
        if robot is not None and its.name != robot.name:
            raise ConfigError(
                f"{log.path}: is of {its.name}, and the logs before of {robot.name}: a dataset has one robot"
            )
        robot = its
        if digest in known:
            report.line(f"{log.path}: is in the dataset already")
            continue
        known.add(digest)
        if not log.complete:
            report.line(f"{log.path}: was cut short: what there is of it is taken")
        found = list(episodes_of(log, its, args.task))
        episodes += found
        about["logs"].append({"file": log.path.name, "sha256": digest, "episodes": len(found)})
    if not episodes or robot is None:
        report.line(f"{args.out}: nothing to add")
        return {"out": args.out, "added": 0}
    from servoid.tools.learn.dataset.camera import CAMERA, film

    tasks = tuple(dict.fromkeys(text for episode in episodes for text in episode.tasks))
    cameras = {CAMERA: (size[1], size[0])} if args.film else {}
    with (
        DatasetWriter(args.out, schema_of(robot, tasks, cameras), append=True) as writer,
        tempfile.TemporaryDirectory() as folder,
    ):
        for episode in episodes:
            films = {CAMERA: film(episode, Path(folder) / "film.mp4", size)} if args.film else {}
            writer.add(episode.columns, np.array([tasks.index(text) for text in episode.tasks]), films)
        writer.finish({SOURCES: yaml.safe_dump(about, sort_keys=False)})
    more = f"{len(episodes)} episode{'s' * (len(episodes) != 1)} more"
    report.line(f"{args.out}: {more}, {writer.episodes} in all, {writer.frames} frames")
    report.line(f"next: servoid dataset show {args.out}")
    return {"out": args.out, "added": len(episodes), "episodes": writer.episodes, "frames": writer.frames}


def _about(args: argparse.Namespace) -> dict[str, Any]:
    """meta/servoid.yaml as it was, with a list of logs. Raises ConfigError where a new dataset has no licence."""
    import yaml

    path = args.out / "meta" / SOURCES
    about: dict[str, Any] = {}
    if path.is_file():
        about = yaml.safe_load(path.read_text(encoding="utf-8")) or {}
    elif not (args.out / "meta" / "info.json").is_file():
        if not args.licence:
            raise ConfigError("--licence: missing: who may use the dataset?")
        about = {"licence": args.licence}
    return {**about, "logs": list(about.get("logs", ()))}

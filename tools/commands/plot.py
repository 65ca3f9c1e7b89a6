"""Draw a recorded run: its path from above, velocities, tilt, joints, supply and tick timing. Several logs are drawn
over each other. `--joints` draws the targets and positions of joints instead, `--video` a film, and `--strip` pictures
of the second in its middle, or of more (`--strip-seconds`), from two sides.
"""

from __future__ import annotations

import argparse
import math
from collections.abc import Sequence
from pathlib import Path
from typing import Any

from servoid.hw.config import ConfigError, nearest
from servoid.hw.robot.description import load_robot
from servoid.stack.log.flightlog import FlightLog, read_log
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Progress, add_json_argument, reporting
from servoid.tools.common.pictures import panels
from servoid.tools.common.pictures.caption import heading
from servoid.tools.common.pictures.drawing import choose_filming, prepare
from servoid.tools.common.pictures.panels import Panel, Shown, new_figure, save_figure
from servoid.tools.common.summary import OUTCOMES

COLOURS = ("#3459b8", "#d1495b", "#2e8b57", "#8a5fbf")  # of several logs


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", type=Path, nargs="+", metavar="LOG", help="flight log (.mcap); several over each other")
    parser.add_argument("--joints", metavar="NAME,NAME", help="draw targets and positions of these joints instead")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="picture to write, PNG (default: beside the first log)"
    )
    parser.add_argument("--video", type=Path, metavar="FILE", help="film a log instead: MP4")
    parser.add_argument("--strip", type=Path, metavar="FILE", help="draw moments of a log side by side instead: PNG")
    parser.add_argument(
        "--strip-seconds", type=float, default=1.0, metavar="S", help="how much of it (default: %(default)s)"
    )
    parser.add_argument(
        "--video-size", default="1280x720", metavar="WxH", help="size of the film (default: %(default)s)"
    )
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        logs = [read_log(path) for path in args.log]
        made: dict[str, Any] = {}
        if args.video is not None:
            made["video"] = _film(logs, args)
        elif args.strip is not None:
            made["strip"] = _strip(logs, args.strip, args.strip_seconds)
        else:
            out = args.out or args.log[0].with_name("-".join(path.stem for path in args.log) + ".png")
            plot_runs(logs, out, None if args.joints is None else args.joints.split(","))
            made["plot"] = out
        for log in logs:
            if not log.complete:
                report.line(f"{log.path}: cut short; what is there was drawn")
        for path in made.values():
            report.line(str(path))
        report.result(made | {"complete": all(log.complete for log in logs)})
    return exit_codes.DONE


def _film(logs: Sequence[FlightLog], args: argparse.Namespace) -> Path:
    if len(logs) > 1:
        raise ConfigError("--video: a film shows one run: name one log")
    path: Path = args.video
    size = prepare(path, args.video_size)
    from servoid.tools.common.pictures.video import VideoError, make_video

    try:
        with Progress("filming") as progress:
            make_video(logs[0], path, size, progress)
    except VideoError as error:
        raise ConfigError(f"--video: {error}") from None
    return path


def _strip(logs: Sequence[FlightLog], path: Path, seconds: float) -> Path:
    if len(logs) > 1:
        raise ConfigError("--strip: a strip shows one run: name one log")
    if path.suffix != ".png":
        raise ConfigError(f"--strip {path}: give a name that ends in .png")
    if not seconds > 0.0:
        raise ConfigError(f"--strip-seconds must be positive, not {seconds:g}")
    choose_filming("--strip")
    from servoid.sim.render import RenderError
    from servoid.tools.common.pictures.video import middle_frames
    from servoid.tools.motions.film import COLUMNS, strip, write_picture

    robot = load_robot(logs[0].header["settings"]["robot"])
    try:
        write_picture(path, strip(middle_frames(logs[0], COLUMNS, seconds), robot))
    except (RenderError, OSError) as error:
        raise ConfigError(f"--strip: {error}") from None
    return path


def plot_path(log: FlightLog, out: Path) -> None:
    """The path from above alone, with goal and plans. Raises ModuleNotFoundError without matplotlib."""
    figure, (axes,) = new_figure(1, 1, (6.4, 6.0))
    panels.path(axes, Shown(log))
    axes.set_title(title(log), fontsize=10)
    save_figure(figure, out)


def plot_runs(logs: Sequence[FlightLog], out: Path, joints: Sequence[str] | None = None) -> None:
    """Everything about one run, or several over each other, or the named joints of them, on one page.

    Raises ConfigError for a log without states, or a joint that one does not have.
    """
    shown = []
    for number, log in enumerate(logs):
        if not log.messages["/state"]:
            raise ConfigError(f"{log.path}: holds no state: the run ended before every sensor was read")
        label = "" if len(logs) == 1 else chr(ord("A") + number)
        shown.append(Shown(log, label, COLOURS[number % len(COLOURS)], number, len(logs)))
    drawn: Sequence[Panel] = panels.PAGE
    if joints is not None:
        for one in shown:
            for name in joints:
                if name not in one.names:
                    raise ConfigError(f"--joints: {one.log.path}: no joint '{name}': {nearest(name, one.names)}")
        drawn = [panels.joint(name) for name in joints]
    columns = 3 if joints is None else min(len(drawn), 2)
    rows = math.ceil(len(drawn) / columns)
    figure, axes = new_figure(rows, columns, (16.0, 12.0) if joints is None else (8.0 * columns, 3.6 * rows))
    figure.suptitle("\n".join((f"{one.label}: " if one.label else "") + title(one.log) for one in shown))
    for panel, place in zip(drawn, axes, strict=False):
        for one in shown:
            panel(place, one)
    for place in axes[len(drawn) :]:
        place.set_axis_off()
    save_figure(figure, out)


def title(log: FlightLog) -> str:
    """What ran, and how it ended."""
    result = log.result
    end = "cut short" if result is None else OUTCOMES[result["outcome"]]
    if result is not None and "seconds" in result:
        end = f"{end} after {result['seconds']:.1f} s"
    return f"{heading(log)}: {end}"

"""Run a task on a robot.

Writes a flight log for `servoid plot` and `servoid replay`. Ctrl-C lowers the robot and turns torque off; a second
Ctrl-C turns torque off at once. Exit code 0: the task succeeded; 1: it failed; 4: the guard stopped the run.
"""

from __future__ import annotations

import argparse
import sys
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoid.hw.config import ConfigError
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Progress, Report, add_json_argument, reporting
from servoid.tools.common.parser import (
    add_gain_argument,
    add_recover_argument,
    add_set_argument,
    check_seed,
    out_of_reach,
    positive,
    settings,
)
from servoid.tools.common.pictures.drawing import prepare
from servoid.tools.common.prompt import confirm
from servoid.tools.web.launch import add_foxglove_argument, add_view_arguments, open_page, tell_page, view_of

if TYPE_CHECKING:
    from servoid.stack.runtime.result import Result
    from servoid.stack.runtime.run import Confirm, RunSettings
    from servoid.tools.common.live import LiveLine

EXIT_CODES = {
    "succeeded": exit_codes.DONE,
    "failed": exit_codes.FAILED,
    "fell": exit_codes.FAILED,
    "timed_out": exit_codes.FAILED,
    "stopped": exit_codes.STOPPED,
    "interrupted": exit_codes.INTERRUPTED,
}


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("task", metavar="TASK", help="task: a name (see servoid tasks) or FILE.py:Class")
    parser.add_argument("--backend", default="sim", metavar="NAME", help="sim, virtual or dynamixel (default: sim)")
    parser.add_argument("--port", metavar="PATH", help="serial port of the robot (--backend dynamixel)")
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    parser.add_argument(
        "--policy",
        default="diffusion",
        metavar="NAME|FILE",
        help="controller: expert, gait, a checkpoint, diffusion settings or FILE.py:Class (default: diffusion)",
    )
    parser.add_argument(
        "--randomise", action="store_true", help="draw the simulated robot's mass, friction, delays and more"
    )
    parser.add_argument("--seconds", type=positive, metavar="S", help="length of the task (default: the task's)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: 0)")
    add_set_argument(parser)
    add_gain_argument(parser)
    add_recover_argument(parser)
    parser.add_argument("--start", action="store_true", help="let a real robot move without asking")
    parser.add_argument("--record", type=Path, metavar="FILE", help="flight log (default: runs/DATE-TASK.mcap)")
    parser.add_argument("--video", type=Path, metavar="FILE", help="film the run afterwards: MP4, and its path as PNG")
    parser.add_argument(
        "--video-size", default="1280x720", metavar="WxH", help="size of the film (default: %(default)s)"
    )
    parser.add_argument("--fast", action="store_true", help="simulate as fast as possible, also on a terminal")
    add_view_arguments(parser)
    add_foxglove_argument(parser)
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        check_seed(args.seed)
        if args.video is not None:
            size = prepare(args.video, args.video_size)
        from servoid.stack.log.recorder import free_name
        from servoid.stack.runtime.backends import backend_kind
        from servoid.stack.runtime.run import RunSettings, run
        from servoid.stack.tasks import find
        from servoid.tools.common.live import LiveLine
        from servoid.tools.common.summary import summary

        args.view |= args.foxglove is not None  # the page's process is what serves it
        watched = (sys.stdout.isatty() and not args.json) or args.view or find(args.task).cls.steered
        plan = RunSettings(
            task=args.task,
            backend=args.backend,
            robot=args.robot,
            policy=args.policy,
            randomise=args.randomise,
            seconds=args.seconds,
            seed=args.seed,
            gain=args.gain,
            set=settings(args),
            start=args.start,
            record=args.record or free_name(find(args.task).name, Path("runs")),
            realtime=(watched and not args.fast) if backend_kind(args.backend).simulated else None,
            port=args.port,
            recover=args.recover,
        )
        for text in out_of_reach(args):
            report.line(text)
        live = LiveLine(sys.stderr if args.json else sys.stdout)
        asks = partial(confirm, remedy="give --start to let the robot move")
        try:
            result = _shown(report, args, plan, live, asks) if args.view else run(plan, on_tick=live, confirm=asks)
        finally:
            live.close()
            tell_lateness(report, args.port)
        files: dict[str, Any] = {"log": result.log}
        for text in summary(result, report.columns):
            report.line(text)
        if args.video is not None and result.log is not None:
            files |= _film(report, result.log, args.video, size)
        for name, path in files.items():
            if path is not None:
                report.line(f"{name:>8}: {path}")
        chosen = {name: vars(args)[name] for name in ("task", "policy", "backend", "robot", "seed")}
        report.result(chosen | {"randomised": args.randomise} | result.summary() | files)
    return EXIT_CODES[result.outcome]


def _shown(report: Report, args: argparse.Namespace, plan: RunSettings, live: LiveLine, asks: Confirm) -> Result:
    """The run, on the page."""
    from servoid.tools.web.watched import check_steered, watched_run

    check_steered(plan)
    with open_page(view_of(args), plan.robot) as page:
        tell_page(report, page)
        return watched_run(page.link, plan, on_tick=live, confirm=asks)


def tell_lateness(report: Report, port: str | None) -> None:
    """Of a virtual rig in real time: what it kept waiting is not the cable's fault."""
    if port is not None and Path(port + ".control").is_socket():  # where `servoid virtual --link` puts it
        from servoid.hw.contracts.body import BackendError
        from servoid.sim.rig.process.control import Control

        try:
            control = Control(port + ".control")
            text = control.lateness()
            control.close()
        except BackendError as error:
            text = str(error)
        if text is not None:
            report.line(text)


def _film(report: Report, log: Path, path: Path, size: tuple[int, int]) -> dict[str, Path]:
    """Video and plot of a run; where they cannot be made, the reason. The run itself has succeeded or not before."""
    from servoid.stack.log.flightlog import read_log
    from servoid.tools.common.pictures.video import VideoError, make_video

    made: dict[str, Path] = {}
    failures = (VideoError, ConfigError, OSError, ValueError)  # a full disk, say, or no encoder
    try:
        with Progress("filming") as progress:
            make_video(read_log(log), path, size, progress)
        made["video"] = path
    except failures as error:
        report.line(f"no video: {error}")
    try:
        from servoid.tools.commands.plot import plot_path

        plot_path(read_log(log), path.with_suffix(".png"))
        made["plot"] = path.with_suffix(".png")
    except ModuleNotFoundError as error:
        report.line(f"no plot: {exit_codes.explain(error)}")
    except failures as error:
        report.line(f"no plot: {error}")
    return made

"""Join two clips into one, blended into each other."""

from __future__ import annotations

import argparse

from servoid.tools.common.exit_codes import DONE
from servoid.tools.common.output import reporting
from servoid.tools.motions.verbs.options import add_library_arguments, add_out_arguments, clip_of, out_library


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("first", metavar="FIRST", help="clip: name in the library, or file")
    parser.add_argument("second", metavar="SECOND", help="clip that follows it")
    parser.add_argument("--name", required=True, help="name of the new clip")
    parser.add_argument("--seconds", type=float, default=0.3, metavar="S", help="length of the blend (default: 0.3)")
    add_out_arguments(parser)
    add_library_arguments(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        first, robot = clip_of(args.first, args)
        second, _ = clip_of(args.second, args)
        clip = first.followed_by(second, round(args.seconds * robot.rate), args.name)
        path = out_library(args, robot).add(clip, replace=args.replace)
        report.line(f"{path}: {clip.ticks * robot.dt:.1f} s")
        report.result({"path": path, "name": clip.name, "seconds": clip.ticks * robot.dt})
    return DONE

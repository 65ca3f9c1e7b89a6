"""Swap left and right of a clip."""

from __future__ import annotations

import argparse

from servoid.policy.motion.clip import other_side
from servoid.tools.common.exit_codes import DONE
from servoid.tools.common.output import reporting
from servoid.tools.motions.verbs.options import add_library_arguments, add_out_arguments, clip_of, out_library


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("clip", metavar="CLIP", help="name in the library, or file")
    parser.add_argument("--name", help="name of the mirrored clip (default: left and right swapped in the name)")
    add_out_arguments(parser)
    add_library_arguments(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        clip, robot = clip_of(args.clip, args)
        swapped = "-".join(other_side(word) for word in clip.name.split("-"))
        name = args.name or (swapped if swapped != clip.name else f"{clip.name}-mirrored")
        path = out_library(args, robot).add(clip.mirrored(robot, name), replace=args.replace)
        report.line(f"{path}: '{clip.name}' with left and right swapped")
        report.result({"path": path, "name": name})
    return DONE

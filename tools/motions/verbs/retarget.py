"""Put a person's motion on the robot: BVH (.bvh, such as CMU's), or a clip of DeepMimic (.txt, .json).

The motion is scaled to the robot and followed by inverse kinematics: a foot that stands has one place, flat on the
ground; the centre of mass keeps its balance; the motion is slowed down where servos could not follow. Needs the
`motions` extra.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.tools.common.exit_codes import DONE
from servoid.tools.common.output import add_json_argument, reporting
from servoid.tools.motions.verbs.options import add_out_arguments, out_library


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, metavar="FILE", help="motion of a person: .bvh, or .txt of DeepMimic")
    parser.add_argument("--name", required=True, help="name of the clip")
    parser.add_argument(
        "--caption", action="append", required=True, metavar="TEXT", help="what the clip shows; may be repeated"
    )
    parser.add_argument("--licence", required=True, metavar="TEXT", help="licence of the file")
    parser.add_argument("--from", dest="first", type=float, default=0.0, metavar="S", help="begin here in the file")
    parser.add_argument("--to", dest="last", type=float, metavar="S", help="end here in the file (default: its end)")
    parser.add_argument(
        "--pace",
        type=float,
        default=1.0,
        metavar="X",
        help="1: as bodies of the robot's size move (default); 0.5: half",
    )
    add_out_arguments(parser)
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Raises ConfigError."""
    from servoid.policy.motion.clip import About
    from servoid.tools.motions.checks import check
    from servoid.tools.motions.human.key_points import read
    from servoid.tools.motions.retarget import retarget

    with reporting(args.json) as report:
        robot = load_robot(args.robot)
        if not 0.1 <= args.pace <= 5.0:
            raise ConfigError(f"--pace {args.pace:g}: must be between 0.1 and 5")
        try:
            about = About(tuple(args.caption), f"{args.file.name}, retargeted", args.licence)
        except ValueError as error:
            raise ConfigError(str(error)) from None
        motion = read(args.file)
        seconds = motion.ticks / motion.rate
        last = seconds if args.last is None else args.last
        if not 0.0 <= args.first < last <= seconds + 1e-9:
            raise ConfigError(f"--from {args.first:g} --to {last:g}: must be within the {seconds:.2f} s of {args.file}")
        motion = motion.cut(round(args.first * motion.rate), round(last * motion.rate))
        library = out_library(args, robot)
        clip = retarget(motion, robot, args.name, about, pace=args.pace)
        path = library.add(clip, replace=args.replace)
        made, figures = clip.ticks * robot.dt, check(clip, robot)
        report.line(
            f"{path}: {made:.1f} s of {last - args.first:.1f} s; beyond limits: {figures['wrong'] or 'nothing'}"
        )
        report.line(
            f"next: servoid motions play {clip.name} --library {args.out}, to see whether it stays up open loop"
        )
        report.result({"path": path, "name": clip.name, "seconds": made, "of_seconds": last - args.first, **figures})
    return DONE

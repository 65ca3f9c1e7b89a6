"""Put people's motions on the robot: BVH (.bvh, such as CMU's), or clips of DeepMimic (.txt, .json).

A motion is scaled to the robot and followed by inverse kinematics: a foot that stands has one place, flat on the
ground; the centre of mass keeps its balance; the motion is slowed down where servos could not follow. Needs the
`motions` extra. With several files it makes a clip of each, called as its file, and lists which ones the servos do not
allow, and why.
"""

from __future__ import annotations

import argparse
from pathlib import Path
from typing import Any

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import Robot, load_robot
from servoid.policy.motion.clip import About
from servoid.policy.motion.library import Library
from servoid.tools.common.exit_codes import DONE
from servoid.tools.common.output import add_json_argument, reporting
from servoid.tools.motions.verbs.options import add_out_arguments, out_library


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "files", nargs="+", type=Path, metavar="FILE", help="motion of a person: .bvh, or .txt of DeepMimic"
    )
    parser.add_argument("--name", help="name of the clip (default: the file's)")
    parser.add_argument(
        "--caption", action="append", metavar="TEXT", help="what it shows; may be repeated (default: its name)"
    )
    parser.add_argument("--licence", required=True, metavar="TEXT", help="licence of the files")
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
    with reporting(args.json) as report:
        robot = load_robot(args.robot)
        if not 0.1 <= args.pace <= 5.0:
            raise ConfigError(f"--pace {args.pace:g}: must be between 0.1 and 5")
        if args.name is not None and len(args.files) > 1:
            raise ConfigError(f"--name {args.name}: is for one file; clips of several are called as their files")
        library = out_library(args, robot)
        if len(args.files) == 1:
            rows = [_made(args.files[0], args, robot, library)]
        else:
            rows = [_made_or_why_not(file, args, robot, library) for file in args.files]
        keys = ("clip", "of_seconds", "seconds", "floating_mm", "sinking_mm", "slip_mmps", "stands", "refused")
        report.table(keys, [tuple(_text(row.get(key)) for key in keys) for row in rows])
        report.result({"library": library.folder, "clips": rows})
    return DONE


def _made_or_why_not(file: Path, args: argparse.Namespace, robot: Robot, library: Library) -> dict[str, Any]:
    try:
        return _made(file, args, robot, library)
    except ConfigError as error:
        return {"clip": file.stem, "refused": str(error).removeprefix(f"clip '{file.stem}': ")}


def _made(file: Path, args: argparse.Namespace, robot: Robot, library: Library) -> dict[str, Any]:
    from servoid.tools.motions.checks import check
    from servoid.tools.motions.human.key_points import read
    from servoid.tools.motions.physics import play
    from servoid.tools.motions.retarget import retarget

    name = args.name or file.stem
    try:
        about = About(tuple(args.caption or [name]), f"{file.name}, retargeted", args.licence)
    except ValueError as error:
        raise ConfigError(str(error)) from None
    motion = read(file)
    whole = motion.ticks / motion.rate
    last = whole if args.last is None else args.last
    if not 0.0 <= args.first < last <= whole + 1e-9:
        raise ConfigError(f"--from {args.first:g} --to {last:g}: must be within the {whole:.2f} s of {file}")
    motion = motion.cut(round(args.first * motion.rate), round(last * motion.rate))
    clip = retarget(motion, robot, name, about, pace=args.pace)
    return {
        "clip": name,
        "path": library.add(clip, replace=args.replace),
        "seconds": clip.ticks * robot.dt,
        "of_seconds": last - args.first,
        **check(clip, robot),
        "stands": bool(play(clip.joints, robot).stands[0]),
    }


def _text(value: object) -> str:
    if value is None:
        return "-"
    if isinstance(value, bool):
        return "yes" if value else "no"
    return f"{value:.2g}" if isinstance(value, float) else str(value)

"""Make clips from keyframes: a YAML file of poses, times and captions. `authored` is the shipped one.

A keyframe says where the feet are, how high and how tilted the base is, which foot carries, where the hands reach and
how the other joints stand; the base moves so that the centre of mass rests where it is asked to. The goals are what
servos that give under load hold the poses by. A keyframe takes longer than it says where a joint would be too fast.
"""

from __future__ import annotations

import argparse

from servoid.hw.robot.description import load_robot
from servoid.tools.common.exit_codes import DONE
from servoid.tools.common.output import add_json_argument, reporting
from servoid.tools.motions.verbs.options import add_out_arguments, out_library


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("recipe", metavar="NAME|FILE", help="keyframes: a YAML file, or `authored`, the shipped one")
    parser.add_argument("--clip", action="append", metavar="NAME", help="only this clip; may be repeated")
    add_out_arguments(parser)
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Raises ConfigError."""
    from servoid.hw.config import ConfigError, nearest, resolve
    from servoid.tools.motions.author import author
    from servoid.tools.motions.keyframes import load_authored

    with reporting(args.json) as report:
        robot = load_robot(args.robot)
        recipe = load_authored(args.recipe)
        names = [name for clip in recipe.clips for name in (clip.name, clip.mirrored) if name is not None]
        for name in args.clip or ():
            if name not in names:
                raise ConfigError(f"--clip {name}: {nearest(name, names)}")
        library = out_library(args, robot)
        made = []
        for clip in author(recipe, robot, f"keyframes of {resolve('motions', args.recipe).name}"):
            if args.clip and clip.name not in args.clip:
                continue
            path = library.add(clip, replace=args.replace)
            seconds = clip.ticks * robot.dt
            report.line(f"{path}: {seconds:.1f} s, {clip.about.begins} to {clip.about.ends}")
            made.append({"path": path, "name": clip.name, "seconds": seconds, "ticks": clip.ticks})
        last = made[-1]["name"]
        report.line(f"next: servoid motions play {last} --library {args.out}, to see whether it stays up open loop")
        report.result({"clips": made})
    return DONE

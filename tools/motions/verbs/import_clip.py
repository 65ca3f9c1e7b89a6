"""Make clips from an action file of ROBOTIS (.bin), a flight log of this project (.mcap) or a LeRobot dataset.

From an action file it plays the chain of pages that starts with --page, as the firmware does, in physics, which gives
the motion of the base; or it makes all clips of a --recipe, a YAML file that lists pages, names and captions. From a
flight log it takes the goals that were sent, or with --measured where the joints were, and the motion of the base that
the robot estimated. From a dataset it
takes the actions of an --episode, and the motion of the base, or where there is none that of physics.
"""

from __future__ import annotations

import argparse
from collections.abc import Iterable
from pathlib import Path

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import Robot, load_robot
from servoid.policy.checkpoint import difference
from servoid.policy.motion.clip import POSES, Clip
from servoid.tools.common.exit_codes import DONE
from servoid.tools.common.output import add_json_argument, reporting
from servoid.tools.motions.action_file import read_pages
from servoid.tools.motions.recipe import PageClip, Recipe, load_recipe, make_clips
from servoid.tools.motions.verbs.options import add_out_arguments, out_library


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "file", type=Path, metavar="FILE", help="action file (.bin), flight log (.mcap) or dataset (folder)"
    )
    parser.add_argument(
        "--recipe", metavar="NAME|FILE", help="clips to make of an action file, such as op3-action-file"
    )
    one = parser.add_argument_group("one clip, instead of a recipe")
    one.add_argument("--name", help="name of the clip")
    one.add_argument("--page", type=int, metavar="N", help="first page of an action file")
    one.add_argument("--episode", type=int, metavar="N", help="episode of a dataset (default: the only one)")
    one.add_argument(
        "--caption", action="append", default=[], metavar="TEXT", help="what the clip shows; may be repeated"
    )
    one.add_argument("--licence", metavar="TEXT", help="licence of the clip, such as Apache-2.0")
    for end in ("begins", "ends"):
        about = f"how the clip {end}: {', '.join(POSES)} (default: upright)"
        one.add_argument(f"--{end}", choices=POSES, default="upright", metavar="POSE", help=about)
    one.add_argument("--measured", action="store_true", help="of a flight log: where joints were, not their goals")
    one.add_argument(
        "--part", type=float, nargs=2, metavar=("FROM", "UNTIL"), help="of a flight log: these seconds of its task"
    )
    one.add_argument("--loop", action="store_true", help="the last frame leads back to the first")
    add_out_arguments(parser)
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Raises ConfigError."""
    with reporting(args.json) as report:
        robot = load_robot(args.robot)
        if args.file.suffix not in (".bin", ".mcap") and not args.file.is_dir():
            raise ConfigError(f"{args.file}: not an action file (.bin), a flight log (.mcap) or a dataset's folder")
        for option, fits in (("page", args.file.suffix == ".bin"), ("episode", args.file.is_dir())):
            if vars(args)[option] is not None and not fits:
                raise ConfigError(f"--{option} {vars(args)[option]}: {args.file} has none: drop it")
        if args.file.suffix != ".mcap" and (args.measured or args.part is not None):
            raise ConfigError(f"--measured and --part are of flight logs, and {args.file} is none: drop them")
        recipe = _recipe(args)
        library = out_library(args, robot)
        clips: Iterable[Clip]
        if args.file.suffix == ".bin":
            clips = make_clips(args.file, recipe, robot)
        elif args.file.is_dir():
            from servoid.tools.motions.verbs.episodes import clip_of_episode

            wanted = recipe.clips[0]
            source = f"dataset {args.file.resolve().name}, episode {args.episode or 0}"
            about = wanted.about(source, recipe.licence)
            clips = [clip_of_episode(args.file, args.episode, robot, wanted.name, about)]
        else:
            clips = [_from_log(args, recipe.clips[0], recipe.licence, robot)]
        made = []
        for clip in clips:
            path = library.add(clip, replace=args.replace)
            seconds = clip.ticks * robot.dt
            report.line(f"{path}: {seconds:.1f} s, {clip.about.begins} to {clip.about.ends}")
            made.append({"path": path, "name": clip.name, "seconds": seconds, "ticks": clip.ticks})
        last = made[-1]["name"]
        report.line(f"next: servoid motions play {last} --library {args.out}, to see whether it stays up open loop")
        report.result({"clips": made})
    return DONE


def _recipe(args: argparse.Namespace) -> Recipe:
    """What to make, by the recipe or by the options of one clip."""
    if args.recipe is not None:
        if args.name is not None or args.page is not None:
            raise ConfigError("--recipe names its clips itself: drop --name and --page")
        if args.file.suffix != ".bin":
            raise ConfigError(f"--recipe {args.recipe}: is for action files: use --name instead")
        return load_recipe(args.recipe)
    for option in ("name", "caption", "licence"):
        if not vars(args)[option]:
            raise ConfigError(f"--{option}: missing; a clip needs --name, --caption and --licence, or give a --recipe")
    if args.page is None and args.file.suffix == ".bin":
        named = ", ".join(f"{page.number} {page.name}".strip() for page in read_pages(args.file).values())
        raise ConfigError(f"{args.file}: page missing; choose one with --page: {named}")
    page = PageClip(args.page or 0, args.name, tuple(args.caption), args.begins, args.ends, args.loop)
    return Recipe(args.licence, (page,))


def _from_log(args: argparse.Namespace, wanted: PageClip, licence: str, robot: Robot) -> Clip:
    from servoid.stack.log.flightlog import read_log

    file, log = args.file, read_log(args.file)
    ticks = log.ticks("/instruction")
    if args.part is not None:
        first, end = (round(seconds * robot.rate) for seconds in args.part)
        if not 0 <= first < end <= len(ticks):
            raise ConfigError(
                f"--part {args.part[0]:g} {args.part[1]:g}: the task of {file} lasts from 0 to "
                f"{len(ticks) * robot.dt:g} s"
            )
        ticks = ticks[first:end]
    if len(ticks) < 2:
        raise ConfigError(f"{file}: holds no motion, because its task never started")
    states, commands = (np.isin(log.ticks(channel), ticks) for channel in ("/state", "/command"))
    theirs = tuple(joint["name"] for joint in log.header["robot"]["joints"])
    if theirs != robot.names:
        raise ConfigError(f"{file}: is of another robot than {robot.name}: {difference(theirs, robot.names)}")
    if (rate := log.header["robot"]["rate"]) != robot.rate:
        raise ConfigError(f"{file}: was recorded at {rate} ticks a second, and {robot.name} runs at {robot.rate}")
    joints = log.column("/command", "position")[commands]
    if args.measured:
        joints = log.column("/state", "position")[states].astype(float)
    place, turn, contact = (
        log.column("/state", field)[states].astype(float) for field in ("displacement", "orientation", "contact")
    )
    return Clip(wanted.name, joints, place, turn, contact, wanted.about(f"flight log {file.name}", licence)).placed()

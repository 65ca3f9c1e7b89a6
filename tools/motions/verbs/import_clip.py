"""Import a motion from a file: an action file of ROBOTIS (.bin), or a flight log of this project (.mcap).

Of an action file, the chain of pages that begins with --page is played as the firmware plays it, in physics, where the
way of the base comes from. Of a flight log, the goals that were sent are taken, and the way that the robot believed to
have gone.
"""

from __future__ import annotations

import argparse
from pathlib import Path

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import Robot, load_robot
from servoid.policy.motion.clip import About, Clip
from servoid.tools.common.exit_codes import DONE
from servoid.tools.common.output import add_json_argument, reporting
from servoid.tools.motions.action_file import chain, joint_goals, read_pages
from servoid.tools.motions.verbs.options import add_about_arguments, add_out_arguments, out_library

AFTER_SECONDS = 0.5  # that the last goal is held, so that what it leads to is seen


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("file", type=Path, help="action file (.bin) or flight log (.mcap)")
    parser.add_argument("--name", required=True, help="of the clip")
    parser.add_argument("--page", type=int, metavar="N", help="first page of an action file")
    add_about_arguments(parser)
    add_out_arguments(parser)
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        robot = load_robot(args.robot)
        library = out_library(args, robot)
        make = {".bin": _from_action_file, ".mcap": _from_log}.get(args.file.suffix)
        if make is None:
            raise ConfigError(f"{args.file}: not an action file (.bin) or a flight log (.mcap)")
        clip = make(args, robot)
        path = library.add(clip, replace=args.replace)
        report.line(f"{path}: {clip.ticks * robot.dt:.1f} s, {clip.about.begins} to {clip.about.ends}")
        report.line(
            f"next: servoid motions play {clip.name} --library {args.out}, to see whether it stays up open loop"
        )
        report.result({"path": path, "name": clip.name, "seconds": clip.ticks * robot.dt, "ticks": clip.ticks})
    return DONE


def _about(args: argparse.Namespace, source: str) -> About:
    try:
        return About(tuple(args.caption), source, args.licence, args.begins, args.ends, args.loop)
    except ValueError as error:
        raise ConfigError(f"--caption, --licence: {error}") from None


def _from_action_file(args: argparse.Namespace, robot: Robot) -> Clip:
    """Raises ConfigError, also where a goal is beyond a joint's range: another motion would be played."""
    from servoid.tools.motions.physics import play

    if args.page is None:
        named = ", ".join(f"{page.number} {page.name}".strip() for page in read_pages(args.file).values())
        raise ConfigError(f"{args.file}: say which page with --page; it has {named}")
    pages = chain(read_pages(args.file), args.page, args.file)
    goals = joint_goals(pages, robot, robot.home)
    if args.begins != "upright":  # nobody lies in the home pose: the first goal is where it begins
        goals = joint_goals(pages, robot, _first_goals(goals))
    beyond = np.maximum(robot.lower - goals, goals - robot.upper).max(0)
    if (beyond > 0.01).any():
        far = [f"{robot.names[i]} by {beyond[i]:.2f}" for i in np.flatnonzero(beyond > 0.01)]
        raise ConfigError(
            f"{args.file}: page {args.page} goes beyond the joint ranges of {robot.name}: {', '.join(far)} rad"
        )
    held = np.concatenate([goals, np.repeat(goals[-1:], round(AFTER_SECONDS * robot.rate), 0)])
    source = f"{args.file.name}, pages {', '.join(str(page.number) for page in pages)}"
    return play(held, robot, begins=args.begins).as_clip(args.name, _about(args, source))


def _first_goals(goals: np.ndarray) -> np.ndarray:
    """The pose that a motion first comes to rest in, or its last one where it never does."""
    still = np.abs(np.diff(goals, axis=0)).max(1) < 1e-6
    moving = np.flatnonzero(~still)
    rest = np.flatnonzero(still[moving[0] :]) if len(moving) else np.array([], int)
    return goals[moving[0] + rest[0]] if len(rest) else goals[-1]


def _from_log(args: argparse.Namespace, robot: Robot) -> Clip:
    from servoid.stack.log.flightlog import read_log

    log = read_log(args.file)
    ticks = log.ticks("/instruction")
    if len(ticks) < 2:
        raise ConfigError(f"{args.file}: its task never began: there is no motion in it")
    states, commands = (np.isin(log.ticks(channel), ticks) for channel in ("/state", "/command"))
    clip = Clip(
        args.name,
        log.column("/command", "position")[commands],
        log.column("/state", "displacement")[states].astype(float),
        log.column("/state", "orientation")[states].astype(float),
        log.column("/state", "contact")[states].astype(float),
        _about(args, f"flight log {args.file.name}"),
    )
    if clip.joints.shape[1] != len(robot.joints):
        raise ConfigError(f"{args.file}: has {clip.joints.shape[1]} joints, and {robot.name} {len(robot.joints)}")
    return clip.placed()

"""What the verbs of `servoid motions` share: which robot, which library, which clip."""

from __future__ import annotations

import argparse
from pathlib import Path

from servoid.hw.robot.description import Robot, load_robot
from servoid.policy.motion.clip import SUFFIX, Clip, load
from servoid.policy.motion.library import SHIPPED, Library
from servoid.tools.common.output import add_json_argument


def add_library_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--library", type=Path, default=SHIPPED, metavar="DIR", help="folder of clips (default: the shipped one)"
    )
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    add_json_argument(parser)


def add_out_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--out", type=Path, required=True, metavar="DIR", help="folder to write the clip into")
    parser.add_argument("--replace", action="store_true", help="overwrite a clip of the same name")


def open_library(args: argparse.Namespace) -> Library:
    """Raises ConfigError."""
    return Library(load_robot(args.robot), args.library)


def clip_of(name: str, args: argparse.Namespace) -> tuple[Clip, Robot]:
    """A clip by name in the library, or by the path of its file, and its robot. Raises ConfigError."""
    robot = load_robot(args.robot)
    return load(Path(name), robot) if name.endswith(SUFFIX) else Library(robot, args.library)[name], robot


def out_library(args: argparse.Namespace, robot: Robot) -> Library:
    """The library that `--out` names; it is made where there is none. Raises ConfigError."""
    from servoid.hw.config import ConfigError

    try:
        args.out.mkdir(parents=True, exist_ok=True)
    except OSError as error:
        raise ConfigError(f"--out {args.out}: cannot be created ({error.strerror})") from None
    return Library(robot, args.out)

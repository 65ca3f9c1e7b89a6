"""Make a clip of the gait at one velocity: a cycle of it, as a loop. It is a reference, which nobody has executed."""

from __future__ import annotations

import argparse

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import Robot, load_robot
from servoid.policy.motion.clip import About, Clip
from servoid.policy.references.gait import Gait
from servoid.tools.common.exit_codes import DONE
from servoid.tools.common.output import reporting
from servoid.tools.motions.verbs.options import add_library_arguments, add_out_arguments, out_library

_LICENCE = "Apache-2.0"  # of the gait
_SETTLED = 6.0  # s until it walks as it is asked


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--name", required=True, help="name of the clip")
    parser.add_argument(
        "--velocity", type=float, nargs=3, required=True, metavar=("FORWARD", "LEFT", "TURN"), help="m/s, m/s and rad/s"
    )
    add_out_arguments(parser)
    add_library_arguments(parser)


def main(args: argparse.Namespace) -> int:
    """Raises ConfigError."""
    with reporting(args.json) as report:
        robot = load_robot(args.robot)
        clip = cycle(robot, args.name, np.array(args.velocity))
        path = out_library(args, robot).add(clip, replace=args.replace)
        report.line(f"{path}: a cycle of {clip.ticks - 1} ticks")
        report.result({"path": path, "name": clip.name, "ticks": clip.ticks})
    return DONE


def cycle(robot: Robot, name: str, velocity: np.ndarray) -> Clip:
    """One cycle of a robot's gait at `velocity` `(3,)` m/s, m/s, rad/s, whose last frame leads on to its first.

    Raises ConfigError for one that is not walking, or beyond what the robot can do.
    """
    walking = robot.walking
    if not np.isfinite(velocity).all() or not velocity.any():
        raise ConfigError(f"--velocity {_text(velocity)}: a robot that stands has no gait; ask it to move")
    beyond = (velocity < walking.lower - 1e-9) | (velocity > walking.upper + 1e-9)
    if beyond.any():
        raise ConfigError(
            f"--velocity {_text(velocity)}: {robot.name} goes from {_text(walking.lower)} to {_text(walking.upper)}"
        )
    gait = Gait(robot)
    for _ in range(round(_SETTLED * robot.rate / gait.cycle_ticks) * gait.cycle_ticks):
        gait.command(velocity)
        gait.advance()
    frames = gait.frames(np.arange(gait.cycle_ticks + 1))
    about = About(
        captions=(f"{name.replace('-', ' ')} at {_text(velocity)}",),
        source=f"servoid motions gait --name {name} --velocity {_text(velocity)}",
        licence=_LICENCE,
        loop=True,
    )
    return Clip(name, frames.position, frames.root_position, frames.root_orientation, frames.contact, about).placed()


def _text(velocity: np.ndarray) -> str:
    return " ".join(f"{part:g}" for part in velocity)

"""Draft a robot's file from its MJCF or URDF, draw the robot, and list what a person must fill in.

Joints, ranges and mirror pairs are read from the model by its geometry; feet are the lowest bodies at the ends of its
limbs. Where the model has no keyframe, knees are bent for the home pose. What no model says, such as servos and their
IDs, is guessed and marked with TODO.
"""

from __future__ import annotations

import argparse
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING

from servoid.hw.config import ConfigError
from servoid.tools.common.output import add_json_argument, reporting
from servoid.tools.common.pictures.drawing import choose_drawing

if TYPE_CHECKING:
    from servoid.tools.robots.draft import Draft


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `servoid robot import`."""
    parser.add_argument("model", type=Path, metavar="FILE", help="MJCF or URDF of the robot")
    parser.add_argument(
        "--out", type=Path, metavar="FILE", help="robot's file to write (default: NAME.yaml in this folder)"
    )
    parser.add_argument(
        "--servo", default="xm430-w350", metavar="NAME", help="servo of all joints (default: xm430-w350)"
    )
    parser.add_argument("--base", metavar="BODY", help="the base (default: the free body with the most joints)")
    parser.add_argument("--imu", metavar="SITE", help="the IMU's site (default: one whose name has imu in it)")
    parser.add_argument("--no-picture", action="store_false", dest="picture", help="do not draw the robot")
    parser.add_argument("--force", action="store_true", help="write over a file that is there")
    add_json_argument(parser)


def _write(found: Draft, out: Path) -> None:
    try:
        out.write_text(found.text(out))
    except OSError as error:
        raise ConfigError(f"{out}: cannot be written: {error.strerror}") from error


def main(args: argparse.Namespace) -> int:
    """Draft, and draw where this machine can; returns 0. Raises ConfigError."""
    with reporting(args.json) as report:
        draws = bool(args.picture)
        if draws:
            try:
                choose_drawing("the picture")
            except ConfigError as error:  # to draw all the same would end the process
                report.line(f"no picture: {error}")
                draws = False
        from servoid.hw.robot.description import load_robot
        from servoid.sim.model import build
        from servoid.tools.robots.compare import overlaps
        from servoid.tools.robots.draft import Choices, draft
        from servoid.tools.robots.home import drafted_home
        from servoid.tools.robots.pictures import poses

        out = args.out or Path(f"{args.model.stem}.yaml")
        if out.exists() and not args.force:
            raise ConfigError(f"{out}: is there already: give another --out, or --force")
        found = draft(args.model, Choices(args.servo, args.base, args.imu))
        _write(found, out)
        robot, notes = load_robot(out), list(found.notes)
        if not found.posed:
            home = drafted_home(robot)
            if home is None:
                notes.append(
                    "home of every joint: the model has no keyframe, and its zero angles were taken: legs are bent "
                    "there already, or reach no pose of bent knees whose soles are level and under the centre of mass; "
                    "on straight knees no robot can walk"
                )
            else:
                notes.append("home of every joint: the model has no keyframe; its knees were bent by geometry")
                found = found.at_home(home)
                _write(found, out)
                robot = load_robot(out)
        if pairs := overlaps(robot, build(robot)):
            notes.append(
                f"{', '.join(f'{one} and {other}' for one, other in pairs)}: their shapes overlap at home, and would "
                "push each other away; listed as `overlapping`, they pass through each other"
            )
            found = replace(found, overlapping=tuple(pairs))
            _write(found, out)
            robot = load_robot(out)
        report.line(
            f"wrote {out}: {len(found.joints)} joints, feet {', '.join(found.feet) or 'none'}, base {found.base}"
        )
        for note in notes:
            report.line(f"  to do: {note}")
        report.line(
            f"{robot.name} stands {robot.standing_height:.3f} m high at home; legs of "
            f"{', '.join(link.joint for link in next(iter(robot.legs.values())))} and their mirrors"
        )
        pictures = poses(robot, out.with_suffix(".png"), report) if draws else None
        report.line(f"next: fill in what is marked TODO, then: servoid robot check {out}")
        report.result({"out": str(out), "picture": pictures, "todo": notes, "joints": list(robot.names)})
    return 0

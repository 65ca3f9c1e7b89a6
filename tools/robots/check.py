"""Compare a robot's file with its model in all that can be compared, and draw the robot.

Kinematics are compared with MuJoCo's at random poses, mirrors and ranges with the model's geometry, and the home pose
with what its servos can hold: their torque, and whether they are stiff enough that the robot does not topple.
"""

from __future__ import annotations

import argparse
from pathlib import Path

from servoid.hw.config import ConfigError
from servoid.tools.common import exit_codes
from servoid.tools.common.output import add_json_argument, reporting
from servoid.tools.common.pictures.drawing import choose_drawing


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `servoid robot check`."""
    parser.add_argument("robot", nargs="?", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    parser.add_argument(
        "--picture", type=Path, metavar="FILE", help="draw the robot in four poses, and where to look, as a .png"
    )
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Compare; returns 1 where something has to be looked at. Raises ConfigError."""
    with reporting(args.json) as report:
        picture: Path | None = args.picture
        if picture is not None:
            try:
                choose_drawing("--picture")
            except ConfigError as error:  # to draw all the same would end the process
                report.line(f"no picture: {error}")
                picture = None
        from servoid.hw.robot.description import load_robot
        from servoid.tools.robots.compare import findings
        from servoid.tools.robots.pictures import poses

        robot = load_robot(args.robot)
        found = findings(robot)
        report.table(("", "what", "found"), [("ok" if one.good else "look", one.what, one.found) for one in found])
        wrong = [one for one in found if not one.good]
        if picture is not None:
            poses(robot, picture, report, tuple(place for one in wrong for place in one.places))
        report.line(f"{robot.name}: {len(wrong)} to look at" if wrong else f"{robot.name}: all fits")
        report.result({"ok": not wrong, "findings": [vars(one) for one in found]})
    return exit_codes.DONE if not wrong else exit_codes.FAILED

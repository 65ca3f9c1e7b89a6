"""Compare every register that matters with the robot's file.

`--fix` writes what differs, with torque off, and compares again. Nothing moves. Exit code 0: the robot matches its
file; 1: something differs.
"""

from __future__ import annotations

import argparse
from dataclasses import asdict
from typing import TYPE_CHECKING

from servoid.tools.bringup.desk.terminal import Desk
from servoid.tools.bringup.line import add_line_arguments, assembled, open_line
from servoid.tools.bringup.scan import joint_of, misfits
from servoid.tools.bringup.session import at_desk
from servoid.tools.common import exit_codes
from servoid.tools.web.launch import add_view_arguments

if TYPE_CHECKING:
    from servoid.hw.dynamixel.transport.bus import Bus
    from servoid.hw.robot.description import Robot


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_line_arguments(parser)
    add_view_arguments(parser)
    parser.add_argument("--fix", action="store_true", help="correct what differs")


def main(args: argparse.Namespace) -> int:
    return at_desk(args, "check", work)


def work(args: argparse.Namespace, desk: Desk) -> int:
    """Do it, and tell the person at the desk."""
    report = desk.report
    from servoid.hw.dynamixel.servos.register_check import as_table, compare, correct, find_board, find_servos
    from servoid.hw.dynamixel.transport.bus import LONGEST_RETURN_DELAY

    robot = assembled(args, report)
    with open_line(args, robot) as line:
        line.bus.return_delay = LONGEST_RETURN_DELAY  # until the servos' own is known
        find_board(line.bus, robot)
        found = find_servos(line.bus, robot)
        before = left = compare(robot, found)
        board = "" if robot.bus.board == "none" else " and the board"
        report.line(f"{len(found)} servos{board} answer; {len(before)} registers differ")
        if before:
            report.line(as_table(before))
        stiff = [f"{servo.joint.name} (ID {servo.joint.id})" for servo in found if servo.get("torque_enable")]
        strange = strangers(line.bus, robot)
        for text in strange:
            report.line(f"! {text}")
        if stiff:
            report.line(f"torque is on at {', '.join(stiff)}: servoid bringup off turns it off")
        if before and args.fix:
            correct(line.bus, found, before)
            left = compare(robot, find_servos(line.bus, robot))
            report.line(f"written {len(before)} registers, read back: {len(left)} differ")
            if left:
                report.line(as_table(left))
    if not left and not strange:
        report.line(f"all as {robot.name} needs it")
    elif left and not args.fix:
        report.line("servoid bringup check --fix writes what is wanted")
    report.result(
        {
            "servos": len(found),
            "torque": stiff,
            "differences": [asdict(difference) for difference in before],
            "fixed": len(before) - len(left) if args.fix else 0,
            "left": [asdict(difference) for difference in left],
            "strangers": strange,
            "ready": not left and not strange,
        }
    )
    return exit_codes.FAILED if left or strange else exit_codes.DONE


def strangers(bus: Bus, robot: Robot) -> list[str]:
    """What is to be done about servos that are no joint's and yet on the robot's bus, at its baud: one may obey a
    joint's ID as its secondary one."""
    from servoid.hw.dynamixel.servos.bus_scan import census

    found = census(bus, [robot.bus.baud])
    return [text for each in found.servos if joint_of(each, robot) is None for text in misfits(each, found, robot)]

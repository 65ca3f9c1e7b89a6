"""Switch torque off, wherever it is on.

Another program may have ended and left it on. Servos are braked for 0.4 s first, so that a robot settles instead of
dropping; then it is limp: hold it. Exit code 3: a servo did not report that its torque is off.
"""

from __future__ import annotations

import argparse

from servoid.hw.contracts.body import BackendError
from servoid.hw.robot.description import load_robot
from servoid.tools.bringup.line import add_line_arguments, open_line
from servoid.tools.bringup.scan import check_baud, named
from servoid.tools.common import exit_codes
from servoid.tools.common.output import reporting
from servoid.tools.common.prompt import confirm


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_line_arguments(parser)
    parser.add_argument("--baud", type=int, metavar="N", help="baud of the bus (default: the robot's)")
    parser.add_argument("--yes", action="store_true", help="switch torque off without asking")


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        from servoid.hw.dynamixel.servos.bus_scan import census, let_go

        robot = load_robot(args.robot)
        baud = robot.bus.baud if args.baud is None else args.baud
        check_baud(baud)
        with open_line(args, robot) as line:
            # The board's power switch is left as it is: a servo without power has no torque.
            found = census(line.bus, [baud])
            stiff = [device for device in found.servos if device.get("torque_enable")]
            names = [named(device, robot) for device in stiff]
            left = []
            if stiff:
                report.line(f"torque is on at {', '.join(names)}")
                if not args.yes:
                    confirm("They will go limp: hold the robot")
                left = [named(device, robot) for device in let_go(line.bus, stiff)]
                if not left:
                    report.line(f"torque is off at {len(stiff)} servos, read back")
            else:
                report.line(f"{len(found.servos)} servos answer at {baud} bit/s, and none has torque")
        if left:
            raise BackendError(
                f"{', '.join(left)} did not report that torque is off: hold the robot and switch its power off"
            )
        report.result({"servos": len(found.servos), "off": names})
    return exit_codes.DONE

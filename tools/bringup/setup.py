"""Give a servo its ID and baud, one servo at a time.

Plug in one servo, alone or behind the board, and name the joint that it is for. A fresh servo answers with ID 1 at
57600 bit/s; one that was used before is found at any baud. It keeps the numbers without power. Nothing moves. More than
one servo on the bus is refused, and so is one with torque on.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from servoid.hw.config import ConfigError, nearest
from servoid.hw.contracts.body import BackendError
from servoid.hw.robot.checks import MAX_ID
from servoid.hw.robot.description import Robot, load_robot
from servoid.tools.bringup.line import add_line_arguments, is_virtual, open_line
from servoid.tools.bringup.scan import check_baud
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Report, reporting
from servoid.tools.common.prompt import confirm

if TYPE_CHECKING:
    from servoid.hw.dynamixel.servos.bus_scan import Device
    from servoid.hw.dynamixel.transport.bus import Bus


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("joint", nargs="?", help="joint that the servo is for: ID, baud and model are its file's")
    add_line_arguments(parser)
    parser.add_argument("--id", type=int, metavar="N", help="new ID, instead of naming a joint")
    parser.add_argument("--baud", type=int, metavar="N", help="new baud (default: the robot's)")
    parser.add_argument("--yes", action="store_true", help="write without asking")


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        robot = load_robot(args.robot)
        id, baud, model = _wanted(args, robot)
        factory_state = None
        if is_virtual(args):
            from servoid.sim.rig.factory_state import FactoryState

            alone = (args.joint or robot.joints[0].name,)
            factory_state = FactoryState(fresh=alone, only=alone)
        with open_line(args, robot, factory_state=factory_state) as line:
            device = find_one(line.bus, robot, baud, report)
            if model is not None and device.model != model:
                wanted = robot.servos[robot.names.index(args.joint)].name
                raise BackendError(f"{device} is not the {wanted} that {robot.name} has at {args.joint}: take another")
            if device.get("torque_enable"):
                raise BackendError(
                    f"{device} has torque on, which locks its EEPROM: servoid bringup off --baud {device.baud}"
                )
            changes = _changes(device, id, baud)
            if changes:
                report.line(f"will be written: {', '.join(changes)}")
                if not args.yes:
                    confirm("It is kept without power")
                from servoid.hw.dynamixel.servos.bus_scan import assign

                after = assign(line.bus, device, id, baud)
                report.line(f"done: {after} answers and reads back")
            else:
                after = device
                report.line("it is set up already: nothing to write")
        report.result(
            {
                "joint": args.joint,
                "model": device.name,
                "before": {"id": device.id, "baud": device.baud},
                "after": {"id": after.id, "baud": after.baud},
                "written": bool(changes),
            }
        )
    return exit_codes.DONE


def find_one(bus: Bus, robot: Robot, baud: int, report: Report) -> Device:
    """The only servo on the bus. Raises BackendError when there is none, or more than one."""
    from servoid.hw.dynamixel.servos.bus_scan import BAUDS, FACTORY_BAUD, census, power_on

    power = power_on(bus, robot.bus.board_id, [robot.bus.baud, *BAUDS])
    report.line(power or f"no board with ID {robot.bus.board_id}: the servo needs a supply of its own")
    likely = list(dict.fromkeys([robot.bus.baud, FACTORY_BAUD, baud]))
    found = census(bus, likely, report.line)
    if not found.servos and not found.problems:
        found = census(bus, [other for other in BAUDS if other not in likely], report.line)
    if found.problems:
        raise BackendError(found.problems[0])
    if not found.servos:
        raise BackendError(
            "no servo answers at any baud: is it plugged in, is its supply on, and is it a Dynamixel of Protocol 2.0?"
        )
    if len(found.servos) > 1:
        there = "; ".join(map(str, found.servos[:4])) + (" ..." if len(found.servos) > 4 else "")
        raise BackendError(f"{len(found.servos)} servos answer ({there}): unplug all but the one to be set up")
    report.line(f"found: {found.servos[0]}")
    return found.servos[0]


def _wanted(args: argparse.Namespace, robot: Robot) -> tuple[int, int, int | None]:
    """ID, baud and, with a joint, the model number that the servo shall have."""
    baud = robot.bus.baud if args.baud is None else args.baud
    check_baud(baud)
    if args.joint is not None:
        if args.id is not None:
            raise ConfigError("give a joint or --id, not both: a joint's ID is that of the robot's file")
        if args.joint not in robot.names:
            raise ConfigError(f"{robot.name} has no joint '{args.joint}'; {nearest(args.joint, robot.names)}")
        i = robot.names.index(args.joint)
        return robot.joints[i].id, baud, robot.servos[i].model_number
    if args.id is None:
        raise ConfigError("say which joint the servo is for (servoid bringup setup JOINT), or which --id it shall have")
    if not 0 <= args.id <= MAX_ID:
        raise ConfigError(f"--id {args.id}: servo IDs are 0..{MAX_ID}")
    if args.id == robot.bus.board_id:
        raise ConfigError(f"--id {args.id}: that is the board's (bus.board_id of the robot's file)")
    return args.id, baud, None


def _changes(device: Device, id: int, baud: int) -> list[str]:
    changes = [("ID", device.id, id), ("baud", device.baud, baud)]
    return [f"{name} {old} -> {new}" for name, old, new in changes if old != new]

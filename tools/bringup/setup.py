"""Set a servo's ID and baud, one servo at a time.

Plug in one servo, alone or behind the board, and name the joint that it is for. A factory-new servo answers with ID 1
at 57600 bit/s; a used one is found at any baud. It keeps its ID and baud without power. Nothing moves. In an assembled
robot the servo is set up in place, if it is the only one without a joint; --from chooses one of several. A servo with
torque on is refused, and so is an ID that two servos obey or that another one has.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING

from servoid.hw.config import ConfigError, nearest
from servoid.hw.contracts.body import BackendError
from servoid.hw.robot.checks import MAX_ID
from servoid.hw.robot.description import Robot, load_robot
from servoid.tools.bringup.line import add_line_arguments, is_virtual, open_line
from servoid.tools.bringup.scan import check_baud, joint_of, powered
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Report, reporting
from servoid.tools.common.prompt import confirm

if TYPE_CHECKING:
    from servoid.hw.dynamixel.servos.bus_scan import Census, Device
    from servoid.hw.dynamixel.transport.bus import Bus


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "joint",
        nargs="?",
        metavar="JOINT",
        help="joint that the servo is for; the robot's file has its ID, baud and model",
    )
    add_line_arguments(parser)
    parser.add_argument("--id", type=int, metavar="N", help="new ID, instead of JOINT")
    parser.add_argument("--baud", type=int, metavar="N", help="new baud (default: the robot's)")
    parser.add_argument("--from", type=int, dest="present", metavar="N", help="present ID of the servo")
    parser.add_argument("--from-baud", type=int, metavar="N", help="present baud of the servo")
    parser.add_argument("--yes", action="store_true", help="write without asking")


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        robot = load_robot(args.robot)
        id, baud, model = _wanted(args, robot)
        factory_state = None
        if is_virtual(args):
            from servoid.sim.rig.servo.factory_state import FactoryState

            alone = (args.joint or robot.joints[0].name,)
            factory_state = FactoryState(fresh=alone, only=alone)
        with open_line(args, robot, factory_state=factory_state) as line:
            device = find_one(line.bus, robot, (id, baud), (args.present, args.from_baud), report)
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


def find_one(
    bus: Bus, robot: Robot, wanted: tuple[int, int], present: tuple[int | None, int | None], report: Report
) -> Device:
    """The servo to be set up: the only one on the bus, the only one of an assembled robot that is no joint's yet, or
    the one whose ID and baud are `present`. `wanted` are those that it shall have.

    Raises BackendError when there is none, when it is not clear which, and when others would take what is written.
    """
    from servoid.hw.dynamixel.servos.bus_scan import BAUDS, FACTORY_BAUD, census

    report.line(powered(bus, robot, BAUDS))
    likely = list(dict.fromkeys([robot.bus.baud, FACTORY_BAUD, wanted[1]]))
    if present[1] is not None:
        likely = list(dict.fromkeys([*likely, present[1]]))
    found = census(bus, likely, report.line)
    if not _matching(found.servos, robot, present):
        others = census(bus, [other for other in BAUDS if other not in likely], report.line)
        found.devices += others.devices
        found.problems += others.problems
    device = _chosen(found, robot, present)
    for other in found.servos:
        if other is not device and other.baud == device.baud and other.get("secondary_id") == device.id:
            raise BackendError(
                f"{other} obeys ID {device.id} too (its secondary ID), and would take what is written: "
                "servoid bringup check --fix first, or unplug it"
            )
        if other is not device and (other.id, other.baud) == wanted:
            name = joint_of(other, robot)
            raise BackendError(
                f"ID {other.id} at {other.baud} bit/s is {f'{name} already' if name else 'another servo'} ({other}): "
                "unplug that one, or give this one another ID"
            )
    report.line(f"found: {device}")
    return device


def _matching(servos: list[Device], robot: Robot, present: tuple[int | None, int | None]) -> list[Device]:
    """Servos that may be meant."""
    id, baud = present
    if id is None and baud is None:
        return servos if len(servos) == 1 else [device for device in servos if joint_of(device, robot) is None]
    return [device for device in servos if id in (None, device.id) and baud in (None, device.baud)]


def _chosen(found: Census, robot: Robot, present: tuple[int | None, int | None]) -> Device:
    servos = _matching(found.servos, robot, present)
    if len(servos) == 1 and not any(f"ID {servos[0].id} at {servos[0].baud} bit/s" in text for text in found.problems):
        return servos[0]
    if found.problems:
        raise BackendError(found.problems[0])
    if present != (None, None):
        there = "no servo answers" if not servos else f"{len(servos)} servos answer"
        raise BackendError(
            f"{there} with ID {present[0] or '...'} at {present[1] or 'any'} bit/s: servoid bringup scan"
        )
    if not found.servos:
        raise BackendError(
            "no servo answers at any baud: is it plugged in, is its supply on, and is it a Dynamixel of Protocol 2.0?"
        )
    if not servos:
        raise BackendError(
            f"{len(found.servos)} servos answer, and each has a joint already: choose one with --from ID, or unplug "
            "all but the one to be set up"
        )
    there = "; ".join(map(str, servos[:4])) + (" ..." if len(servos) > 4 else "")
    raise BackendError(
        f"{len(servos)} servos have no joint yet ({there}): choose one with --from ID --from-baud N, or unplug all "
        "but the one to be set up"
    )


def _wanted(args: argparse.Namespace, robot: Robot) -> tuple[int, int, int | None]:
    """ID, baud and, with a joint, the model number that the servo shall have."""
    baud = robot.bus.baud if args.baud is None else args.baud
    check_baud(baud)
    if args.joint is not None:
        if args.id is not None:
            raise ConfigError("name a joint or --id, not both: the robot's file has the joint's ID")
        if args.joint not in robot.names:
            raise ConfigError(f"{robot.name} has no joint '{args.joint}'; {nearest(args.joint, robot.names)}")
        i = robot.names.index(args.joint)
        return robot.joints[i].id, baud, robot.servos[i].model_number
    if args.id is None:
        raise ConfigError(
            "joint missing: name the servo's joint (servoid bringup setup JOINT), or its new ID with --id"
        )
    if not 0 <= args.id <= MAX_ID:
        raise ConfigError(f"--id {args.id}: servo IDs are 0..{MAX_ID}")
    if args.id == robot.bus.board_id and robot.bus.board != "none":
        raise ConfigError(f"--id {args.id}: that is the board's (bus.board_id of the robot's file)")
    return args.id, baud, None


def _changes(device: Device, id: int, baud: int) -> list[str]:
    changes = [("ID", device.id, id), ("baud", device.baud, baud)]
    return [f"{name} {old} -> {new}" for name, old, new in changes if old != new]

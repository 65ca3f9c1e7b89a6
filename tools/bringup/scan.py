"""List the servos and boards on the bus, at every baud.

Lists each servo and board with ID, baud, model, firmware, voltage, temperature and errors, and what does not fit the
robot's file. Switches the servos' power on where a board keeps it off; moves nothing. Exit code 3: something needs
fixing.
"""

from __future__ import annotations

import argparse
from typing import TYPE_CHECKING, Any

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import BackendError
from servoid.hw.robot.checks import MAX_ID
from servoid.hw.robot.description import Robot, load_robot
from servoid.tools.bringup.desk.terminal import Desk
from servoid.tools.bringup.line import add_line_arguments, open_line
from servoid.tools.bringup.session import at_desk
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Report
from servoid.tools.web.launch import add_view_arguments

if TYPE_CHECKING:
    from servoid.hw.dynamixel.servos.bus_scan import Census, Device
    from servoid.hw.dynamixel.transport.bus import Bus


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_line_arguments(parser)
    add_view_arguments(parser)
    parser.add_argument(
        "--baud",
        type=int,
        action="append",
        default=[],
        metavar="N",
        help="only this baud; may be repeated (default: all)",
    )


def main(args: argparse.Namespace) -> int:
    return at_desk(args, "scan", work)


def work(args: argparse.Namespace, desk: Desk) -> int:
    """Do it, and tell the person at the desk."""
    report = desk.report
    from servoid.hw.dynamixel.servos.bus_scan import BAUDS, census

    robot = load_robot(args.robot)
    for baud in args.baud:
        check_baud(baud)
    bauds = args.baud or _first(robot.bus.baud, BAUDS)
    with open_line(args, robot) as line:
        report.line(powered(line.bus, robot, bauds))
        found = census(line.bus, bauds, desk.progress)
    if not found.devices and not found.problems:
        raise BackendError(
            f"{args.port}: no answer at {', '.join(map(str, bauds))} bit/s: is the supply on, is the adapter "
            "on the servos' connector, and do both have the same ground?"
        )
    if found.skipped:
        report.line(f"this adapter cannot be set to {', '.join(map(str, found.skipped))} bit/s: nobody asked there")
    missing = absent(found, robot)
    problems = found.problems + [text for each in found.devices for text in misfits(each, found, robot)]
    if not found.servos and not problems:
        problems.append(
            "the board answers, but no servo does: is the cable from the board to the servos plugged in, and is "
            "the supply on?"
        )
    _show(found, robot, problems, report)
    stiff = [named(device, robot) for device in found.servos if device.get("torque_enable")]
    if stiff:
        report.line(f"torque is on at {', '.join(stiff)}: servoid bringup off turns it off")
    if missing:
        report.line(f"not on the bus at {robot.bus.baud} bit/s: {', '.join(missing)}")
    report.result(
        {
            "port": args.port,
            "bauds": list(bauds),
            "devices": [described(device, robot) for device in found.devices],
            "missing": missing,
            "torque": stiff,
            "problems": problems,
        }
    )
    return exit_codes.HARDWARE if problems else exit_codes.DONE


def powered(bus: Bus, robot: Robot, bauds: tuple[int, ...] | list[int]) -> str:
    """Switch the servos' power on where a board keeps it off; a line about it."""
    from servoid.hw.dynamixel.servos.bus_scan import BOOT_SECONDS, power_on

    if robot.bus.board == "none":
        bus.clock.sleep_until(bus.clock.now_ns() + round(BOOT_SECONDS * 1e9))  # the supply may just have come on
        return f"{robot.name} has no board: its servos have a supply of their own"
    power = power_on(bus, robot.bus.board_id, _first(robot.bus.baud, bauds))
    return power or f"no board with ID {robot.bus.board_id}: servos with a supply of their own may answer"


def check_baud(baud: int) -> None:
    """Raise ConfigError for a baud that no servo has."""
    from servoid.hw.dynamixel.servos.bus_scan import BAUDS

    if baud not in BAUDS:
        raise ConfigError(f"--baud {baud}: Dynamixel servos have {', '.join(map(str, BAUDS))} bit/s")


def joint_of(device: Device, robot: Robot) -> str | None:
    """The joint that a servo is of, by its ID; None at another baud than the robot's, where it is nobody's yet."""
    if device.is_board or device.baud != robot.bus.baud:
        return None
    return next((joint.name for joint in robot.joints if joint.id == device.id), None)


def named(device: Device, robot: Robot) -> str:
    """A servo as a person knows it: by its joint, else by what it is."""
    joint = joint_of(device, robot)
    return f"{joint} (ID {device.id})" if joint else str(device)


def absent(found: Census, robot: Robot) -> list[str]:
    """Joints whose servo does not answer."""
    there = {joint_of(device, robot) for device in found.devices}
    return [f"{joint.name} (ID {joint.id})" for joint in robot.joints if joint.name not in there]


def misfits(device: Device, found: Census, robot: Robot) -> list[str]:
    """What a person should mend about a device, with the remedy; `found` are all."""
    from servoid.hw.faults import describe, remedy

    if device.is_board:
        return []
    texts = []
    if device.table is None:
        texts.append(f"{device}: this model is not known here: is it a Dynamixel of Protocol 2.0?")
    error = device.get("hardware_error_status") or 0
    if error:
        texts.append(f"{device}: reports {', '.join(describe(error))}: {remedy(error)}")
    name = joint_of(device, robot)
    also = device.get("secondary_id")
    obeys = f"obeys ID {also} too (its secondary ID)" if also is not None and also <= MAX_ID else ""
    if name is None:
        there = device.baud == robot.bus.baud
        what = f"no joint of {robot.name} has this ID" if there else f"{robot.name} is at {robot.bus.baud} bit/s"
        setup = f"servoid bringup setup {_candidate(device, found, robot)}"
        texts.append(f"{device}: {what}: {setup}" if not obeys else f"{device}: {obeys}: {setup}, then check --fix")
        return texts
    if obeys:
        texts.append(f"{device}: {obeys}: servoid bringup check --fix")
    servo = robot.servos[robot.names.index(name)]
    if device.model != servo.model_number:
        texts.append(f"{name} (ID {device.id}) is {device.name}, but the robot's file says {servo.name}: change either")
    volts, (low, high) = device.measured("present_input_voltage"), servo.voltage_range
    if volts is not None and not low <= volts <= high:
        texts.append(f"{name} (ID {device.id}) has {volts:.1f} V, outside {low:g} to {high:g} V: check the supply")
    return texts


def _candidate(device: Device, found: Census, robot: Robot) -> str:
    """The words of `setup` that make a servo that is no joint's yet one: of the joint whose ID it has at another baud,
    or of the only one that is missing; else JOINT stands for what only a person knows."""
    missing = [text.partition(" ")[0] for text in absent(found, robot)]
    same = [joint.name for joint in robot.joints if joint.id == device.id and joint.name in missing]
    joint = same[0] if same else missing[0] if len(missing) == 1 else "JOINT"
    return f"{joint} --from {device.id} --from-baud {device.baud}"


def described(device: Device, robot: Robot) -> dict[str, Any]:
    """A device as JSON values."""
    from servoid.hw.faults import describe

    torque = device.get("torque_enable")
    return {
        "id": device.id,
        "baud": device.baud,
        "model": device.name,
        "model_number": device.model,
        "firmware": device.firmware,
        "voltage": device.measured("present_input_voltage"),
        "temperature": device.measured("present_temperature"),
        "torque": None if torque is None else bool(torque),
        "errors": describe(device.get("hardware_error_status") or 0),
        "joint": joint_of(device, robot),
    }


def _show(found: Census, robot: Robot, problems: list[str], report: Report) -> None:
    rows = []
    for device in found.devices:
        values = described(device, robot)
        rows.append(
            (
                device.id,
                device.baud,
                device.name,
                device.firmware,
                _number(values["voltage"], "V", 1),
                _number(values["temperature"], "C", 0),
                {True: "on", False: "off", None: "-"}[values["torque"]],
                ", ".join(values["errors"]) or "-",
                values["joint"] or ("the board" if device.is_board else "-"),
            )
        )
    report.line()
    report.table(("ID", "baud", "model", "firmware", "supply", "heat", "torque", "errors", "joint"), rows)
    report.line()
    report.line(f"{len(found.servos)} servos, {len(found.boards)} board" + ("s" if len(found.boards) != 1 else ""))
    for text in problems:
        report.line(f"! {text}")


def _number(value: float | None, unit: str, digits: int) -> str:
    return "-" if value is None else f"{value:.{digits}f} {unit}"


def _first(baud: int, others: tuple[int, ...] | list[int]) -> list[int]:
    """The robot's own baud before the others."""
    return [baud, *(other for other in others if other != baud)]

"""The line to the servos that a verb works on: a serial port, or a virtual rig of its own."""

from __future__ import annotations

import argparse
from collections.abc import Iterator
from contextlib import ExitStack, contextmanager
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Clock
from servoid.hw.robot.checks import check_bus_port
from servoid.hw.robot.description import Robot, load_robot
from servoid.tools.common.output import Report, add_json_argument

if TYPE_CHECKING:
    from servoid.hw.dynamixel.transport.bus import Bus
    from servoid.sim.rig.process.control import Control
    from servoid.sim.rig.servo.factory_state import FactoryState

VIRTUAL = "virtual"


@dataclass(frozen=True)
class Line:
    """A bus that is open at the robot's baud. `control` is of a virtual rig at its end, None at a real robot."""

    bus: Bus
    clock: Clock
    control: Control | None


def add_line_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--port",
        metavar="PATH|virtual",
        help="serial port of the robot, or 'virtual' for a temporary rig",
    )
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    add_json_argument(parser)


def is_virtual(args: argparse.Namespace) -> bool:
    """Whether the verb has a virtual rig of its own. Raises ConfigError when no port was given."""
    if args.port is None:
        from servoid.tools.bringup.ports import usb_ports

        there = ", ".join(usb_ports()) or "none is plugged in"
        raise ConfigError(
            f"port missing: name it with --port PATH (USB ports here: {there}), or practise with --port {VIRTUAL}"
        )
    return bool(args.port == VIRTUAL)


def assembled(args: argparse.Namespace, report: Report) -> Robot:
    """The robot as its file says or, where there is hardware and it was calibrated, as it was measured."""
    robot = load_robot(args.robot)
    if not is_virtual(args):
        from servoid.hw.dynamixel.calibration import calibrated

        robot, text = calibrated(robot)
        report.line(text)
    return robot


@contextmanager
def open_line(
    args: argparse.Namespace,
    robot: Robot,
    *,
    patient: bool = True,
    factory_state: FactoryState | None = None,
    seed: int = 0,
) -> Iterator[Line]:
    """Open the port that the person named, and be `patient` with it where nothing is known of its adapter yet.

    `factory_state` is of a virtual rig. Raises BackendError with the remedy.
    """
    from servoid.hw.clock import WallClock
    from servoid.hw.dynamixel.servos.bus_scan import PATIENCE
    from servoid.hw.dynamixel.transport.bus import MARGIN, Bus
    from servoid.hw.dynamixel.transport.port import SerialPort

    check_bus_port(robot, str(args.port))
    with ExitStack() as stack:
        clock: Clock = WallClock()
        path, control = str(args.port), None
        if is_virtual(args):
            from servoid.sim.rig.process.control import LockedClock, RigProcess

            rig = stack.enter_context(RigProcess(robot, factory_state=factory_state, seed=seed))
            path, control, clock = rig.port, rig.control, LockedClock(rig.control)
        elif Path(path + ".control").is_socket():  # where `servoid virtual --link` puts it
            from servoid.sim.rig.process.control import Control

            control = Control(path + ".control")
            stack.callback(control.close)
        port = SerialPort(path, robot.bus.baud)
        stack.callback(port.close)
        yield Line(Bus(port, clock, margin=PATIENCE if patient else MARGIN), clock, control)

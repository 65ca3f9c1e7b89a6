"""Serve a virtual rig on a serial port: servos and board that answer real bytes, moved by physics, until Ctrl-C."""

from __future__ import annotations

import argparse
import signal
from pathlib import Path
from types import FrameType

from servoid.hw.config import ConfigError
from servoid.sim.rig.factory_state import add_factory_state_arguments
from servoid.tools.common import exit_codes
from servoid.tools.common.output import add_json_argument, reporting
from servoid.tools.common.parser import check_seed


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="default: op3")
    parser.add_argument("--link", type=Path, metavar="PATH", help="make a link of this name to the port")
    parser.add_argument("--faults", type=Path, metavar="FILE", help="fault scenario (YAML)")
    parser.add_argument(
        "--clock",
        choices=("real", "locked"),
        default="real",
        help="time: the machine's, or only as far as a connection to the control socket advances it (default: real)",
    )
    parser.add_argument("--control", type=Path, metavar="PATH", help="control socket (default: beside --link)")
    parser.add_argument("--seed", type=int, default=0, help="of the sensors' errors")
    parser.add_argument("--randomise", action="store_true", help="another robot within the ranges of training")
    add_factory_state_arguments(parser)
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    from servoid.sim.rig.process.server import build

    with reporting(args.json) as report:
        check_seed(args.seed)
        if args.control is None and args.link is not None:
            args.control = args.link.with_name(args.link.name + ".control")
        if args.clock == "locked" and args.control is None:
            raise ConfigError("--clock locked needs a control socket: give --link or --control")
        try:
            server = build(args)
        except OSError as error:
            raise ConfigError(
                f"the virtual port cannot be made: {error}: choose another --link or --control"
            ) from error

        def stop(signum: int, frame: FrameType | None) -> None:
            server.stop()

        robot = server.rig.robot
        report.line(f"{robot.name}: {len(robot.joints)} servos and the board at {server.port}, {robot.bus.baud} bit/s")
        if args.control is not None:
            report.line(f"control socket: {args.control}")
        report.line("The robot is held above the ground until all servos have torque. Ctrl-C ends it.")
        report.result({"robot": robot.name, "port": server.port, "baud": robot.bus.baud, "control": args.control})
        before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
        try:
            server.serve()
        finally:
            for number, handler in before.items():
                signal.signal(number, handler)
    return exit_codes.DONE

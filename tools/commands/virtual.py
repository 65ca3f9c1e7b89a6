"""Serve a virtual rig on a serial port until Ctrl-C: servos and board that answer real bytes, moved by physics.

Any program that speaks to Dynamixel servos can use the port. While the robot is held and its servos are limp,
`servoid virtual --link PATH --move JOINT=RAD ...` moves joints as a hand would, within `--over` seconds, so that other
programs can record ranges and calibrate.
"""

from __future__ import annotations

import argparse
import json
import signal
import subprocess
import sys
import tempfile
import time
from contextlib import ExitStack
from pathlib import Path
from types import FrameType

from servoid.hw.config import ConfigError
from servoid.sim.rig.servo.factory_state import add_factory_state_arguments
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Report, add_json_argument, reporting
from servoid.tools.common.parser import check_seed
from servoid.tools.web.launch import add_view_arguments, check_installed, view_of

HAND_SECONDS = 0.02  # between two places of a joint that is moved by hand
BOARD_POWER = 24  # register of the board


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    parser.add_argument("--link", type=Path, metavar="PATH", help="link to the port, to be created")
    parser.add_argument("--faults", type=Path, metavar="FILE", help="fault scenario (YAML)")
    parser.add_argument(
        "--clock",
        choices=("real", "locked"),
        default="real",
        help="real time, or time that a client of the control socket advances (default: real)",
    )
    parser.add_argument("--control", type=Path, metavar="PATH", help="control socket (default: beside --link)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: 0)")
    parser.add_argument("--randomise", action="store_true", help="draw the robot's mass, friction, delays and more")
    add_factory_state_arguments(parser)
    parser.add_argument(
        "--move",
        nargs="+",
        metavar="JOINT=RAD",
        help="serve nothing; move limp joints of the rig running at --link or --control",
    )
    parser.add_argument("--over", type=float, default=1.0, metavar="S", help="duration of --move (default: 1)")
    add_view_arguments(parser)
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        check_seed(args.seed)
        if args.link is not None and not args.link.name:
            raise ConfigError(f"--link '{args.link}': give the name of a link that is to be made, such as /tmp/rig")
        if args.control is None and args.link is not None:
            args.control = args.link.with_name(args.link.name + ".control")
        if args.move is not None:
            move(report, args.control, args.move, args.over)
            return exit_codes.DONE
        if args.clock == "locked" and args.control is None:
            raise ConfigError("--clock locked needs a control socket: use --link or --control")
        with ExitStack() as open_:
            if args.view:
                check_installed()
                view_of(args)
                if args.control is None:  # the page asks there where the robot is
                    folder = open_.enter_context(tempfile.TemporaryDirectory(prefix="servoid-"))
                    args.control = Path(folder) / "control"
            serve(report, args)
    return exit_codes.DONE


def serve(report: Report, args: argparse.Namespace) -> None:
    """Until Ctrl-C. Raises ConfigError."""
    from servoid.sim.rig.process.server import build

    try:
        server = build(args, told=report.line)
    except OSError as error:
        raise ConfigError(f"the virtual port cannot be created: {error}: choose another --link or --control") from error

    def stop(signum: int, frame: FrameType | None) -> None:
        server.stop()

    rig = server.rig
    baud = rig.factory_state.bus_baud(rig.robot)
    for line in told(rig.robot.name, len(rig.robot.joints), rig.robot.bus.board_id, baud, server.port, args):
        report.line(line)
    board = rig.robot.bus.board_id if args.board else None
    values = {"robot": rig.robot.name, "port": server.port, "baud": baud, "control": args.control, "board_id": board}
    report.result(values | {"powered": args.powered or not args.board})
    before = {number: signal.signal(number, stop) for number in (signal.SIGINT, signal.SIGTERM)}
    page = _show(args) if args.view else None
    try:
        server.serve()
    finally:
        if page is not None:
            page.terminate()
            page.wait()
        for number, handler in before.items():
            signal.signal(number, handler)


def _show(args: argparse.Namespace) -> subprocess.Popen[bytes]:
    """The page of the rig, beside it."""
    values = {"robot": args.robot, "control": str(args.control), "board": args.board}
    values |= {"host": args.view_host, "port": args.view_port}
    return subprocess.Popen([sys.executable, "-m", "servoid.tools.web.rig_view", json.dumps(values)])


def told(robot: str, servos: int, board_id: int, baud: int, port: str, args: argparse.Namespace) -> list[str]:
    """What a client has to know and to do."""
    board = f" and the board (ID {board_id})" if args.board else ""
    lines = [f"{robot}: {servos} servos{board} at {port}, {baud} bit/s, protocol 2.0"]
    if not args.board:
        lines.append("There is no board: the servos have power.")
    elif args.powered:
        lines.append("The servos have power already.")
    else:
        lines.append(
            f"The servos have no power and are silent until a client writes 1 to register {BOARD_POWER} of the board, "
            f"ID {board_id}; they answer 0.3 s later. A client that knows no board needs --powered or --no-board."
        )
    if args.fresh:
        lines.append(f"Factory-new, ID 1 at 57600 bit/s: {', '.join(args.fresh)}.")
    lines.append("The robot is held above the ground until all servos have torque.")
    if args.control is not None:
        where = f"--link {args.link}" if args.link is not None else f"--control {args.control}"
        lines.append(f"While servos are limp, move their joints by hand: servoid virtual {where} --move JOINT=RAD ...")
    else:
        lines.append("To move its joints by hand, start it with --link or --control.")
    return [*lines, "Ctrl-C ends it."]


def move(report: Report, control_path: Path | None, words: list[str], seconds: float) -> None:
    """Move joints of a rig that runs, evenly, from where they are. Raises ConfigError, and BackendError where the rig
    is gone or refuses: joints that it has not or that have torque, a robot that is not held."""
    import numpy as np

    from servoid.sim.rig.process.control import Control

    if control_path is None:
        raise ConfigError("--move needs a running rig: name its --link or --control")
    if not 0.0 <= seconds < float("inf"):
        raise ConfigError(f"--over must not be negative or infinite, not {seconds}")
    goals = dict(_goal(word) for word in words)
    control = Control(control_path)
    try:
        start = control.joints()
        begin = {name: start.get(name, goal) for name, goal in goals.items()}
        for share in np.linspace(0.0, 1.0, max(round(seconds / HAND_SECONDS), 1) + 1)[1:].tolist():
            control.move({name: begin[name] + share * (goal - begin[name]) for name, goal in goals.items()})
            time.sleep(HAND_SECONDS if seconds else 0.0)
        now = control.joints()
    finally:
        control.close()
    for name in goals:
        report.line(f"{name}: from {begin[name]:+.3f} to {now[name]:+.3f} rad")
    report.result({"joints": {name: now[name] for name in goals}})


def _goal(word: str) -> tuple[str, float]:
    name, _, text = word.partition("=")
    try:
        angle = float(text)
    except ValueError:
        angle = float("nan")
    if not (name and abs(angle) < float("inf")):
        raise ConfigError(f"--move {word}: write JOINT=RAD, such as l_knee=0.5")
    return name, angle

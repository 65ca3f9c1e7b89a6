"""Find the serial port of the robot.

Lists the USB serial ports. On a terminal it then waits for an adapter to be plugged in, or unplugged and plugged in
again, and prints which one it was.
"""

from __future__ import annotations

import argparse
import os
import sys
import time
from dataclasses import asdict

from servoid.hw.contracts.body import BackendError
from servoid.tools.bringup.line import VIRTUAL, add_line_arguments
from servoid.tools.bringup.ports import PortInfo, usb_ports
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Report, reporting
from servoid.tools.common.parser import positive

PATIENCE = 60.0  # s
_POLL = 0.2  # s


def add_arguments(parser: argparse.ArgumentParser) -> None:
    add_line_arguments(parser)
    parser.add_argument(
        "--wait",
        type=positive,
        metavar="S",
        help=f"how long to wait for a change (default: {PATIENCE:g} on a terminal, else 0)",
    )


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        if args.port == VIRTUAL:
            return _virtual(args, report)
        before = usb_ports()
        _show(before, report)
        if args.port is not None and os.path.realpath(args.port) not in before:
            raise BackendError(f"{args.port}: no USB serial port of that name: plug it in, or leave --port out")
        wait = args.wait or (PATIENCE if sys.stdin.isatty() and not args.json else 0.0)
        changed = None
        if wait and args.port is None:
            changed = _watch(before, wait, report)
        report.result(
            {
                "ports": [asdict(port) for port in before.values()],
                "changed": None if changed is None else {"how": changed[0], **asdict(changed[1])},
            }
        )
    return exit_codes.DONE


def _show(ports: dict[str, PortInfo], report: Report) -> None:
    if not ports:
        report.line("no USB serial port here: plug the robot's adapter in")
        return
    report.table(
        ("port", "what", "permission", "name that stays"),
        [(p.path, p.what, "yes" if p.allowed else "no: servoid doctor", p.name) for p in ports.values()],
    )


def _watch(before: dict[str, PortInfo], wait: float, report: Report) -> tuple[str, PortInfo] | None:
    """Tell what comes or goes within `wait` s, and wait as long again for what went; returns the last of it."""
    report.line()
    report.line(f"Unplug the robot's adapter now, or plug it in ({wait:g} s; Ctrl-C leaves).")
    changed = _change(before, wait)
    if changed is not None and changed[0] == "unplugged":
        gone = changed[1]
        report.line(f"unplugged: {gone.path} ({gone.what}). Plug it in again ({wait:g} s; Ctrl-C leaves).")
        others = {path: port for path, port in before.items() if path != gone.path}
        changed = _change(others, wait, coming=True) or changed  # it may have another path now
    if changed is None:
        report.line("nothing changed: is it another cable, or one that only charges?")
        return None
    how, port = changed
    report.line(f"plugged in: {port.path} ({port.what})" if how == "plugged in" else "it is still unplugged")
    if port.name != port.path:
        report.line(f"its name, wherever it is plugged in: {port.name}")
    report.line(f"next: servoid bringup scan --port {port.path}")
    return changed


def _change(before: dict[str, PortInfo], seconds: float, *, coming: bool = False) -> tuple[str, PortInfo] | None:
    """What came or went within so many seconds; what came alone, where it is `coming`."""
    end = time.monotonic() + seconds
    while time.monotonic() < end:
        now = usb_ports()
        if came := now.keys() - before.keys():
            time.sleep(0.5)  # until udev has made its link and given permission
            return "plugged in", usb_ports().get(min(came), now[min(came)])
        if not coming and (gone := before.keys() - now.keys()):
            return "unplugged", before[min(gone)]
        time.sleep(_POLL)
    return None


def _virtual(args: argparse.Namespace, report: Report) -> int:
    """Start a rig, and show where it would be found."""
    from servoid.hw.robot.description import load_robot
    from servoid.sim.rig.process.control import RigProcess

    robot = load_robot(args.robot)
    with RigProcess(robot) as rig:
        report.line(f"a virtual rig of {robot.name} had its port at {rig.port}, {robot.bus.baud} bit/s; it has ended.")
        report.line("One that stays, at a path of your choice: servoid virtual --link /tmp/rig")
        port = PortInfo(rig.port, rig.port, f"virtual rig of {robot.name}", True)
    report.result({"ports": [asdict(port)], "changed": None})
    return exit_codes.DONE

"""Measure how late the control loop is on this machine: the real loop in real time, the gait walking in simulation."""

from __future__ import annotations

import argparse

from servoid.hw.robot.description import load_robot
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.run import RunSettings, run
from servoid.tools.common import exit_codes
from servoid.tools.common.output import add_json_argument, reporting
from servoid.tools.common.parser import positive


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=positive, default=20.0, metavar="S", help="length of the walk (default: 20)")
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        busy: list[float] = []

        def count(record: TickRecord) -> None:
            timing = record.timing
            busy.append((timing.read + timing.estimate + timing.act + timing.guard + timing.write) * 1e-6)

        settings = RunSettings(
            "walk", robot=args.robot, policy="gait", seconds=args.seconds, set={"vx": "0.1"}, realtime=True
        )
        result = run(settings, on_tick=count)
        hz = load_robot(args.robot).rate
        values = {
            "hz": hz,
            "seconds": result.seconds,
            "ticks": result.ticks,
            "late_p50_ms": result.late_p50_ms,
            "late_p99_ms": result.late_p99_ms,
            "missed": result.missed,
            "busy_p50_ms": sorted(busy)[len(busy) // 2],
        }
        report.line(
            f"{hz} Hz, {result.ticks} ticks: late p50 {result.late_p50_ms:.2f} ms, p99 {result.late_p99_ms:.2f} ms,"
            f" {result.missed} missed"
        )
        report.result(values)
    return exit_codes.DONE

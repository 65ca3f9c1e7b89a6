"""Interrupt runs (Ctrl-C) at random instants, on virtual rigs in real time, and check that torque is off afterwards.

Any instant from the first byte on the bus may be drawn: connecting, homing, standing, walking. Every fourth run gets a
second Ctrl-C while the robot comes to rest, is lowered or is damped. All servos must report that torque is off, or the
run must say so by its exit code; and the rig must agree.
"""

from __future__ import annotations

import argparse
import random
import signal
import tempfile
import time
from concurrent.futures import ThreadPoolExecutor
from pathlib import Path
from typing import Any

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import BackendError
from servoid.stack.safety.guard import DAMP_SECONDS, LOWER_SECONDS, REST_SECONDS
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Report, add_json_argument, reporting

SPAN_SECONDS = 6.0  # of a run in which the instants lie
AGAIN = 4  # one run in so many is interrupted twice
AGAIN_SECONDS = REST_SECONDS + LOWER_SECONDS + DAMP_SECONDS
TRIES = 10  # for a run that goes on until then: on a machine that is too busy the guard stops it before


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--times", type=int, default=200, metavar="N", help="number of runs (default: %(default)s)")
    parser.add_argument("--workers", type=int, default=1, metavar="N", help="rigs in parallel (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: %(default)s)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        if args.times < 1 or args.workers < 1:
            raise ConfigError(f"--times {args.times} --workers {args.workers}: both must be at least 1")
        result = summarise(measure(report, args.times, args.workers, args.seed))
        report.table(["figure", "value"], [[key, value] for key, value in result.items()])
        report.result(result)
    return exit_codes.DONE


def measure(report: Report, times: int, workers: int, seed: int) -> list[dict[str, Any]]:
    """A row for each interrupt. An instant depends on its number alone, and not on the number of workers."""

    def work(first: int) -> list[dict[str, Any]]:
        from servoid.tools.faults.controller import free_rig

        rows = []
        with free_rig() as rig, tempfile.TemporaryDirectory(prefix="servoid-interrupt-") as folder:
            for i in range(first, times, workers):
                for attempt in range(TRIES):
                    log, dice = Path(folder) / f"{i}-{attempt}.mcap", random.Random(f"{seed} {i}")
                    row = interrupt(rig, log, dice, i % AGAIN == 0)
                    report.line(f"{i}: " + ", ".join(f"{key} {value}" for key, value in row.items()))
                    rows.append(row)
                    if "void" not in row:
                        break
                else:
                    raise BackendError(f"{TRIES} runs in a row ended before the Ctrl-C: {row['void']}")
        return rows

    with ThreadPoolExecutor(workers) as pool:
        return [row for rows in pool.map(work, range(min(workers, times))) for row in rows]


def interrupt(rig: Any, log: Path, dice: random.Random, again: bool) -> dict[str, Any]:
    """One interrupt. `ms` is when the last servo took torque off, counted from the last Ctrl-C; None without torque. A
    row with `void` says why there was nothing left to interrupt."""
    from servoid.tools.faults.controller import Controller, first_taken, has_none

    rig.control.reset(0)
    with Controller(rig, log) as controller:
        at = dice.uniform(0.0, SPAN_SECONDS)
        begun = controller.wait_for(lambda control: control.statistics()["instructions"] > 0)
        if not (begun and controller.wait_on(at)):
            return {"void": controller.last_words(), "off": has_none(rig.control)}
        ended = has_none(rig.control)
        powered = not ended
        mark = controller.interrupt()
        if again:
            time.sleep(dice.uniform(0.0, AGAIN_SECONDS))
            ended = has_none(rig.control)
            mark = controller.interrupt()
        code, guardian = controller.wait(), "servoid guardian" in controller.errors()
    off = first_taken(rig.control.accepted(), "torque_enable", 0, mark)
    late = rig.control.call("lateness")
    return {
        "rig_latest_ms": round(late["worst_ms"], 1),
        "at_s": round(at, 2),
        "torque": powered,
        "off": has_none(rig.control),
        "acknowledged": code == exit_codes.INTERRUPTED,
        "late": ended and code == -signal.SIGINT,  # torque was off, and the process on its way out
        "code": code,
        "guardian": guardian,
        "ms": round(max(off.values()), 1) if off else None,
    }


def summarise(every: list[dict[str, Any]]) -> dict[str, Any]:
    rows = [row for row in every if "void" not in row]
    spent = [row["ms"] for row in rows if row["ms"] is not None]
    return {
        "runs": len(rows),
        "with_torque": sum(row["torque"] for row in rows),
        "all_off": sum(row["off"] for row in rows),
        "acknowledged": sum(row["acknowledged"] for row in rows),
        "late": sum(row["late"] for row in rows),
        "guardian_needed": sum(row["guardian"] for row in rows),
        "median_ms": sorted(spent)[len(spent) // 2] if spent else None,
        "worst_ms": max(spent, default=None),
        "rig_latest_ms": max((row["rig_latest_ms"] for row in rows), default=None),
        "void": len(every) - len(rows),
        "void_all_off": sum(row["off"] for row in every if "void" in row),
        "other_codes": sorted({row["code"] for row in rows if not (row["acknowledged"] or row["late"])}),
    }

"""Kill the controller in mid-walk (kill -9) and check the servo state after, on a virtual rig in real time.

The guardian must damp all servos and then switch their torque off, within 100 ms by the rig's own record, and the
flight log must be readable. Then the guardian is killed too, and the servos' own watchdog must stop them.
"""

from __future__ import annotations

import argparse
import random
import tempfile
import time
from pathlib import Path
from typing import Any

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import BackendError
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Report, add_json_argument, reporting

WALK_SECONDS = 2.0  # within which the kill comes, after the first step
TRIES = 10  # for a walk that goes on until the kill: on a machine that is too busy the guard stops it before
_LATEST = 1.0  # s after a kill that are waited for what should have come in a tenth of it


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--kills", type=int, default=20, metavar="N", help="kills with a guardian (default: %(default)s)"
    )
    parser.add_argument(
        "--unguarded", type=int, default=5, metavar="N", help="kills of controller and guardian (default: %(default)s)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: %(default)s)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        if args.kills < 0 or args.unguarded < 0 or args.kills + args.unguarded < 1:
            raise ConfigError(f"--kills {args.kills} --unguarded {args.unguarded}: must not be negative, nor both be 0")
        result = measure(report, args.kills, args.unguarded, random.Random(args.seed))
        report.table(["figure", "value"], [[key, value] for key, value in result.items()])
        report.result(result)
    return exit_codes.DONE


def measure(report: Report, kills: int, unguarded: int, dice: random.Random) -> dict[str, Any]:
    """All kills, one after the other on one rig."""
    from servoid.tools.faults.controller import free_rig

    rows: list[dict[str, Any]] = []
    void = 0
    with free_rig() as rig, tempfile.TemporaryDirectory(prefix="servoid-kill-") as folder:
        for i in range(kills + unguarded):
            for attempt in range(TRIES):
                row = kill(rig, Path(folder) / f"{i}-{attempt}.mcap", guarded=i < kills, dice=dice)
                report.line(", ".join(f"{key} {value}" for key, value in row.items()))
                if "void" not in row:
                    rows.append(row)
                    break
                void += 1
            else:
                raise BackendError(f"{TRIES} walks in a row ended before they were killed: {row['void']}")
        late = rig.control.call("lateness")
    return summarise(rows, void) | {"rig_late": late["times"], "rig_latest_ms": round(late["worst_ms"], 1)}


def summarise(rows: list[dict[str, Any]], void: int) -> dict[str, Any]:
    """What `--json` prints. A time of 1000 ms is a bound, of those that are counted as never off, or never stopped."""
    guarded, alone = [row for row in rows if row["guarded"]], [row for row in rows if not row["guarded"]]
    return {
        "runs": len(guarded),
        "all_damped": sum(row["damped"] for row in guarded),
        "all_off": sum(row["off"] for row in guarded),
        "never_off": sum(not row["off"] for row in guarded),
        "median_ms": sorted(row["ms"] for row in guarded)[len(guarded) // 2] if guarded else None,
        "worst_ms": max((row["ms"] for row in guarded), default=None),
        "unguarded_runs": len(alone),
        "unguarded_all_stopped": sum(row["stopped"] for row in alone),
        "unguarded_never_stopped": sum(not row["stopped"] for row in alone),
        "unguarded_worst_ms": max((row["ms"] for row in alone), default=None),
        "walking": sum(row["walking"] for row in rows),
        "logs_read": sum(row["log"] for row in rows),
        "void": void,
    }


def kill(rig: Any, log: Path, *, guarded: bool, dice: random.Random) -> dict[str, Any]:
    """One kill at a random instant of a walk. `ms` is when the last servo was off, or stopped, after the kill; how long
    was waited for it, where it never was. A row with `void` says why there was nothing left to kill."""
    from servoid.tools.faults.controller import STAND_SECONDS, Controller, has_torque

    rig.control.reset(0)
    with Controller(rig, log) as controller:
        begun = controller.wait_for(has_torque) and controller.wait_on(STAND_SECONDS + dice.uniform(0.0, WALK_SECONDS))
        if not (begun and has_torque(rig.control)):
            controller.wait()
            return {"void": controller.last_words()}
        rig.control.accepted()
        mark = controller.kill(guarded=guarded)
        row = _off(rig, mark) if guarded else _stopped(rig, mark)
        controller.wait()
    phase, reads = _last_phase(log)
    return {"guarded": guarded, **row, "walking": phase == "running", "log": reads}


def _off(rig: Any, mark: int) -> dict[str, Any]:
    """Whether the guardian damped all servos before it switched them off, and when the last was off."""
    from servoid.tools.faults.controller import first_taken, has_none

    deadline = time.monotonic() + _LATEST
    while not has_none(rig.control) and time.monotonic() < deadline:
        time.sleep(0.005)
    writes, joints = rig.control.accepted(), range(len(rig.robot.joints))
    damped = first_taken(writes, "position_p_gain", 0, mark)
    off = first_taken(writes, "torque_enable", 0, mark)
    return {
        "off": len(off) == len(joints) and has_none(rig.control),
        "damped": all(i in damped and damped[i] < off.get(i, 0.0) for i in joints),
        "ms": _last(off, len(joints)),
    }


def _stopped(rig: Any, mark: int) -> dict[str, Any]:
    """Whether the watchdog stopped all servos, and when it stopped the last."""
    from servoid.tools.faults.controller import first_taken

    time.sleep(_LATEST)
    stopped = first_taken(rig.control.accepted(), "bus_watchdog", 255, mark)
    joints = len(rig.robot.joints)
    return {"stopped": len(stopped) == joints, "ms": _last(stopped, joints)}


def _last(times: dict[int, float], joints: int) -> float:
    """When the last of the joints had its time [ms]; a lower bound where one has none."""
    return round(max(times.values()), 1) if len(times) == joints else 1000.0 * _LATEST


def _last_phase(log: Path) -> tuple[str | None, bool]:
    """The guard's phase at the end of a log, and whether the log reads back."""
    from servoid.stack.log.flightlog import read_log

    try:
        commands = read_log(log).messages["/command"]
    except ConfigError:
        return None, False
    return (commands[-1]["phase"], True) if commands else (None, False)

"""Inject every fault of the virtual rig while the robot walks, and judge how the run handles it.

Each fault is declared absorbed (the run continues), named (in the log, with the servo) or fatal (named, and the robot
damped and off; where the bus cannot be reached, stopped by the servos' watchdog). Every goal that a servo accepted is
judged against the joint's range and speed by the rig's own record. A trial that hangs is killed and counted, and so is
one whose process dies. To repeat a trial: --fault KIND --first SEED --seeds 1.
"""

from __future__ import annotations

import argparse
import os
import time
from typing import Any

from servoid.hw.config import ConfigError, nearest
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Report, add_json_argument, reporting
from servoid.tools.common.parser import positive

QUICK = (
    "drop",
    "corrupt",
    "dead",
    "overheating",
    "button",
    "vanish",
)  # kinds of a quick campaign: one of each outcome and port
TRIAL_SECONDS = 120.0  # after which a trial hangs: it takes 1 to 2 on a core of its own


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--seeds", type=int, default=20, metavar="N", help="trials of each fault (default: %(default)s)"
    )
    parser.add_argument(
        "--first", type=int, default=0, metavar="SEED", help="seed of the first trial (default: %(default)s)"
    )
    parser.add_argument("--fault", action="append", metavar="KIND", help="only this fault; may be repeated")
    parser.add_argument("--quick", action="store_true", help=f"only {', '.join(QUICK)}")
    parser.add_argument("--workers", type=int, default=0, metavar="N", help="processes (default: one per core)")
    parser.add_argument(
        "--deadline",
        type=positive,
        default=TRIAL_SECONDS,
        metavar="S",
        help="longest trial, in real time (default: %(default)s)",
    )
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    from servoid.sim.rig.wire.faults import KINDS

    with reporting(args.json) as report:
        if args.seeds < 1 or args.first < 0 or args.workers < 0:
            raise ConfigError("--seeds must be at least 1, and --first and --workers must not be negative")
        kinds = tuple(args.fault or (QUICK if args.quick else KINDS))
        for kind in kinds:
            if kind not in KINDS:
                raise ConfigError(f"--fault {kind}: {nearest(kind, KINDS)}")
        begun = time.monotonic()
        verdicts = campaign(report, kinds, range(args.first, args.first + args.seeds), args)
        result = summarise(verdicts)
        result["wall_seconds"] = time.monotonic() - begun
        _print(report, result)
        report.result(result)
    return exit_codes.DONE


def campaign(report: Report, kinds: tuple[str, ...], seeds: range, args: argparse.Namespace) -> list[Any]:
    """All trials' verdicts. Raises ConfigError for an unknown robot before any starts."""
    from tqdm import tqdm

    from servoid.hw.robot.description import load_robot
    from servoid.tools.common.worker_pool import Lost, each_or_lost
    from servoid.tools.faults.trial import Trial, Verdict, run_trial

    load_robot(args.robot)
    trials = [Trial(kind, seed, args.robot) for seed in seeds for kind in kinds]
    verdicts: list[Verdict] = []
    done = each_or_lost(run_trial, trials, args.workers or os.cpu_count() or 1, args.deadline)
    for trial, result in tqdm(done, total=len(trials), unit="trial", mininterval=5.0):
        verdict = lost(trial, result) if isinstance(result, Lost) else result
        verdicts.append(verdict)
        for problem in verdict.problems:
            report.line(f"{verdict.kind} --first {verdict.seed}: {problem}")
    return verdicts


def lost(trial: Any, loss: Any) -> Any:
    """The verdict on a trial that hung or died."""
    from servoid.sim.rig.wire.faults import EXPECTED
    from servoid.tools.faults.trial import Verdict

    return Verdict(trial.kind, trial.seed, EXPECTED[trial.kind].value, ended=loss.how, problems=[loss.text])


def summarise(verdicts: list[Any]) -> dict[str, Any]:
    """What `--json` prints."""
    kinds = sorted({verdict.kind for verdict in verdicts})
    per_fault = {kind: _figures([v for v in verdicts if v.kind == kind]) for kind in kinds}
    for kind, figures in per_fault.items():
        figures["expected"] = next(v.expected for v in verdicts if v.kind == kind)
    return {**_figures(verdicts), "per_fault": per_fault}


def _figures(verdicts: list[Any]) -> dict[str, Any]:
    detected = [v.detection_ticks for v in verdicts if v.expected != "absorbed" and v.detection_ticks is not None]
    off = [v.off_seconds for v in verdicts if v.off_seconds is not None]
    return {
        "runs": len(verdicts),
        "unsafe_goals": sum(v.unsafe_goals for v in verdicts),
        "unnamed_faults": sum(_unnamed(v) for v in verdicts),
        "hangs": sum(v.ended == "hung" for v in verdicts),
        "deaths": sum(v.ended == "died" for v in verdicts),
        "ended_running": sum(v.ended == "running" for v in verdicts),
        "ended_damped": sum(v.ended == "damped" for v in verdicts),
        "falls": sum(v.fell for v in verdicts),
        "worst_detection_ticks": max(detected, default=None),
        "worst_off_seconds": max(off, default=None),
        "not_as_declared": sum(bool(v.problems) for v in verdicts),
        "problems": [f"--fault {v.kind} --first {v.seed}: {p}" for v in verdicts for p in v.problems],
    }


def _unnamed(verdict: Any) -> bool:
    from servoid.tools.faults.trial import DETECTION_TICKS

    if verdict.expected == "absorbed" or verdict.ended in ("hung", "died"):
        return False
    return not verdict.named or verdict.detection_ticks > DETECTION_TICKS


def _print(report: Report, result: dict[str, Any]) -> None:
    head: tuple[str, ...] = (
        "expected",
        "runs",
        "ended_running",
        "ended_damped",
        "falls",
        "unsafe_goals",
        "unnamed_faults",
        "hangs",
        "deaths",
    )
    head += ("worst_detection_ticks", "worst_off_seconds", "not_as_declared")
    rows = [[kind, *(_cell(figures[key]) for key in head)] for kind, figures in result["per_fault"].items()]
    rows.append(["all", "", *(_cell(result[key]) for key in head[1:])])
    report.table(["fault", *(key.replace("_", " ") for key in head)], rows)


def _cell(value: object) -> str:
    return "" if value is None else f"{value:.2f}" if isinstance(value, float) else str(value)

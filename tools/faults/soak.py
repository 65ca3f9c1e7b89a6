"""Walk for minutes in real time on the virtual rig, over a line that loses and damages status packets.

The rig is a separate process in real time, and the robot is driven like hardware: real port, real clock, the same
backend. The run must not stop, the robot must not fall, and memory must not grow.
"""

from __future__ import annotations

import argparse
from array import array
from pathlib import Path
from typing import Any

from servoid.hw.config import ConfigError
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Report, add_json_argument, reporting
from servoid.tools.common.parser import check_seed, positive

TELL_SECONDS = 60.0
VELOCITY = {"vx": "0.1", "vy": "0", "yaw_rate": "0.3"}  # round in a circle, not away


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--minutes", type=positive, default=10.0, metavar="M", help="length of the walk (default: %(default)s)"
    )
    parser.add_argument(
        "--warm-up", type=positive, default=10.0, metavar="S", help="seconds of walking that do not count (default: 10)"
    )
    parser.add_argument(
        "--share", type=float, default=0.01, metavar="X", help="share of packets lost or damaged (default: %(default)s)"
    )
    parser.add_argument(
        "--policy", default="gait", metavar="NAME", help="diffusion, expert or gait (default: %(default)s)"
    )
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: 0)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        if not 0.0 <= args.share <= 1.0:
            raise ConfigError(f"--share {args.share}: must be between 0 and 1")
        check_seed(args.seed)
        result = soak(report, args)
        report.table(["figure", "value"], [[key.replace("_", " "), _cell(value)] for key, value in result.items()])
        report.result(result)
    return exit_codes.DONE


def soak(report: Report, args: argparse.Namespace) -> dict[str, Any]:
    """Walk, and say how it went. Raises ConfigError for an unknown robot or policy, BackendError without a rig."""
    import numpy as np

    from servoid.hw.contracts.body import BackendError
    from servoid.hw.dynamixel.backend import DynamixelBackend
    from servoid.hw.robot.description import load_robot
    from servoid.stack.runtime.run import RunSettings, run
    from servoid.tools.faults.controller import free_rig

    robot = load_robot(args.robot)
    settings = RunSettings(
        "walk",
        backend="dynamixel",
        robot=args.robot,
        policy=args.policy,
        seconds=60.0 * args.minutes + args.warm_up,
        seed=args.seed,
        set=VELOCITY,
        start=True,
    )
    outcome = "error"
    events: list[str] = []
    with free_rig(args.robot, args.seed) as rig:
        body = DynamixelBackend(robot, port=rig.port)
        watch = SoakWatch(rig, robot.rate, args, report)
        try:
            result = run(settings, backend=body, on_tick=watch)
            outcome = result.outcome
            events = [event.text for event in result.events if event.kind not in ("phase", "task", "system")]
        except BackendError as error:
            events = [str(error)]
        counters = body.counters
        struck = sum(each["count"] for each in rig.control.statistics()["struck"])
        late_rig = rig.control.call("lateness")
    late = np.array(watch.late or [0.0])
    return {
        "minutes": watch.ticks / robot.rate / 60.0,
        "outcome": outcome,
        "stopped": outcome not in ("succeeded", "failed", "timed_out"),
        "fell": watch.fell or outcome == "fell",  # which may be between two looks at the truth
        "ticks": watch.ticks,
        "missed": watch.missed,
        "late_p50_ms": float(np.percentile(late, 50)),
        "late_p99_ms": float(np.percentile(late, 99)),
        "rig_late": late_rig["times"],
        "rig_latest_ms": late_rig["worst_ms"],
        "packets_struck": struck,
        "answers_lost": counters.lost,
        "answers_recovered": counters.recovered,
        "rss_start_mb": watch.start_mb,
        "rss_end_mb": watch.end_mb,
        "rig_rss_start_mb": watch.rig_start_mb,
        "rig_rss_end_mb": watch.rig_end_mb,
        "events": events,
    }


class SoakWatch:
    """Listens to a soak run: injects the losses, looks at the truth once a second, and at memory."""

    def __init__(self, rig: Any, rate: int, args: argparse.Namespace, report: Report) -> None:
        self._rig, self._rate, self._report = rig, rate, report
        self._share, self._warm = args.share, round(args.warm_up * rate)
        self._truth = rig.truth()
        self.ticks = self.missed = 0
        self.late = array("d")  # ms
        self.fell = False
        self.start_mb = self.end_mb = self.rig_start_mb = self.rig_end_mb = 0.0

    def __call__(self, record: Any) -> None:
        if record.proposal.instruction is None:
            return
        if self.ticks == 0:
            for kind in ("drop", "corrupt"):  # half of those that are struck are lost, half damaged
                self._rig.control.inject(kind, probability=self._share / 2)
        self.ticks += 1
        if self.ticks > self._warm:
            self.missed += record.timing.missed
            self.late.append(record.timing.late * 1e-6)
        if self.ticks == self._warm:
            self.start_mb, self.rig_start_mb = rss_mb(), rss_mb(self._rig.process.pid)
        if self.ticks % self._rate == 0:  # within the task: a robot that was lowered at its end is no fallen one
            self.fell |= bool(self._truth.fetch().fallen[0])
            self.end_mb, self.rig_end_mb = rss_mb(), rss_mb(self._rig.process.pid)
        if self.ticks % round(TELL_SECONDS * self._rate) == 0:
            self._report.line(f"{self.ticks / self._rate:.0f} s, {self.missed} missed, {self.end_mb:.1f} MB")


def rss_mb(process: int | str = "self") -> float:
    """Memory of a process that is in RAM [MB]."""
    pages = int((Path("/proc") / str(process) / "statm").read_text(encoding="ascii").split()[1])
    return pages * 4096 * 1e-6


def _cell(value: object) -> str:
    if isinstance(value, list):
        return "; ".join(map(str, value[:3])) or "none"
    return f"{value:.3f}" if isinstance(value, float) else str(value)

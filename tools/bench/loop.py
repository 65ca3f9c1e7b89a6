"""Measure how late the control loop is on this machine: the real loop in real time, the gait walking in simulation.

With `--viewers N` the walk is also shown on the operator's page to N viewers, who take 30 pictures a second and draw
nothing: walks with them and without take turns, `--rounds` of each.
"""

from __future__ import annotations

import argparse
import subprocess
import sys
from collections.abc import Iterator
from contextlib import contextmanager
from dataclasses import dataclass, field
from typing import TYPE_CHECKING, Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.run import RunSettings, run
from servoid.stack.safety.phase import Phase
from servoid.tools.common import exit_codes
from servoid.tools.common.output import add_json_argument, reporting
from servoid.tools.common.parser import counted, positive

if TYPE_CHECKING:
    from servoid.tools.web.launch import OpenPage


@dataclass
class Punctuality:
    """The ticks of some walks, ms."""

    late: list[float] = field(default_factory=list)
    busy: list[float] = field(default_factory=list)
    missed: int = 0

    def __call__(self, record: TickRecord) -> None:
        timing = record.timing
        if record.phase is Phase.RUNNING:
            self.late.append(timing.late * 1e-6)
            self.missed += timing.missed
            self.busy.append((timing.read + timing.estimate + timing.act + timing.guard + timing.write) * 1e-6)

    def values(self) -> dict[str, float]:
        p50, p99 = np.percentile(self.late, [50, 99]).tolist()
        return {
            "ticks": len(self.late),
            "late_p50_ms": p50,
            "late_p99_ms": p99,
            "missed": self.missed,
            "busy_p50_ms": float(np.median(self.busy)),
        }


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--seconds", type=positive, default=20.0, metavar="S", help="length of the walk (default: 20)")
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    parser.add_argument("--viewers", type=counted, metavar="N", help="also with so many viewers of the page")
    parser.add_argument("--rounds", type=counted, default=3, metavar="N", help="walks of each kind (default: 3)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        hz = load_robot(args.robot).rate
        alone = Punctuality()
        if args.viewers is None:
            seconds = _walk(args, alone)
            values: dict[str, Any] = {"hz": hz, "seconds": seconds, **alone.values()}
            report.line(_line(f"{hz} Hz", alone))
        else:
            watched, taken = Punctuality(), [0, 0, 0, 0]
            for _ in range(args.rounds):
                _walk(args, alone)
                taken = [a + b for a, b in zip(taken, _watched_walk(args, watched), strict=True)]
            ratio = watched.values()["late_p99_ms"] / max(alone.values()["late_p99_ms"], 1e-6)
            values = {
                "hz": hz,
                "viewers": args.viewers,
                "alone": alone.values(),
                "watched": watched.values(),
                "late_p99_ratio": ratio,
                "taken": dict(
                    zip(("picture_messages", "picture_bytes", "number_messages", "number_bytes"), taken, strict=True)
                ),
            }
            report.line(_line("nobody watches", alone))
            report.line(_line(f"{args.viewers} watch", watched))
            report.line(f"late p99 is {ratio:.2f} times as much; viewers took {(taken[1] + taken[3]) / 1e6:.1f} MB")
        report.result(values)
    return exit_codes.DONE


def _line(what: str, walks: Punctuality) -> str:
    values = walks.values()
    late = f"late p50 {values['late_p50_ms']:.2f} ms, p99 {values['late_p99_ms']:.2f} ms"
    return (
        f"{what}, {values['ticks']} ticks: {late}, {values['missed']} missed, busy p50 {values['busy_p50_ms']:.2f} ms"
    )


def _settings(args: argparse.Namespace) -> RunSettings:
    return RunSettings("walk", robot=args.robot, policy="gait", seconds=args.seconds, set={"vx": "0.1"}, realtime=True)


def _walk(args: argparse.Namespace, walks: Punctuality) -> float:
    return run(_settings(args), on_tick=walks).seconds


def _watched_walk(args: argparse.Namespace, walks: Punctuality) -> list[int]:
    """What viewers took: messages and bytes of pictures, and of numbers. Raises ConfigError where there is no page."""
    from servoid.tools.web.launch import View, open_page
    from servoid.tools.web.watched import watched_run

    with open_page(View(port=0), args.robot) as page, _viewers(page, args.viewers) as taken:
        watched_run(page.link, _settings(args), on_tick=walks)
    return taken


@contextmanager
def _viewers(page: OpenPage, count: int) -> Iterator[list[int]]:
    """Viewers of a page; what they took is in the list in the end. Raises ConfigError where they see nothing."""
    command = [sys.executable, "-m", "servoid.tools.bench.viewers", page.url, str(count)]
    process = subprocess.Popen(command, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    taken: list[int] = []
    with process:
        try:
            if process.stdout.readline() != "watching\n":
                raise ConfigError("the viewers see nothing of the page: what failed is above")
            yield taken
            taken += map(int, process.communicate()[0].split())
        finally:
            process.kill()

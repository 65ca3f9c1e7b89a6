"""Look at a recorded run on the operator's page, with a time line: play it, stop it, and go to any moment.

Prints the page's address and runs until Ctrl-C, or until the page is gone. Any log can be looked at, also one that was
cut short; nothing in it is changed. With two logs, the second one's robot walks beside the first one's, in orange, its
numbers are dashed in the plots, and both begin their task at the same moment.
"""

from __future__ import annotations

import argparse
import select
import time
from collections.abc import Sequence
from dataclasses import replace
from pathlib import Path

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.geometry import turned
from servoid.hw.robot.description import load_robot
from servoid.stack.log.look_back import LoggedTicks
from servoid.stack.log.tick import TickRecord
from servoid.tools.common import exit_codes
from servoid.tools.common.output import add_json_argument, reporting
from servoid.tools.web.launch import add_view_arguments, open_page, view_of
from servoid.tools.web.line.link import PageLink
from servoid.tools.web.line.snapshot import PlanOutcome, RunInfo, Snapshot, Snapshots

FRAME_SECONDS = 1.0 / 30.0
BEFORE = 20.0  # s that are shown before the moment that somebody goes to
EVERY = 5  # of its ticks
BREATH = 0.002  # s
MOST = 2  # logs at once


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", type=Path, nargs="+", metavar="LOG", help="flight log (.mcap), or two to compare")
    parser.add_argument("--robot", metavar="NAME|FILE", help="robot to draw (default: the log's)")
    add_view_arguments(parser, switch=False)
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        if len(args.log) > MOST:
            raise ConfigError(f"{len(args.log)} logs: at most {MOST} can be looked at together")
        began, used = time.monotonic(), time.process_time()
        logs = [LoggedTicks(path) for path in args.log]
        opened, used = time.monotonic() - began, time.process_time() - used
        name = check_alike(args.log, logs, args.robot)
        with open_page(view_of(args), name) as page:
            for path, log in zip(args.log, logs, strict=True):
                report.line(f"{path}: {len(log)} ticks, {log.times[-1]:.0f} s")
            page_seconds = time.monotonic() - began - opened
            report.line(
                f"read in {opened:.1f} s, {used:.1f} s of them of the processor; the page took {page_seconds:.1f} s"
            )
            report.line(f"page: {page.url}")
            try:
                Player(page.link, logs, name).play()
            except KeyboardInterrupt:
                report.line("ended by Ctrl-C")
        first = logs[0]
        report.result(
            {"log": args.log, "ticks": len(first), "complete": first.complete, "read_s": opened, "read_cpu_s": used}
        )
    return exit_codes.DONE


def check_alike(paths: Sequence[Path], logs: Sequence[LoggedTicks], robot: str | None) -> str:
    """The robot to draw. Raises ConfigError where the logs are of several."""
    names = [log.header["settings"]["robot"] for log in logs]
    for path, name in zip(paths, names, strict=True):
        if name != names[0] and robot is None:
            raise ConfigError(f"{path}: is of {name}, and {paths[0]} of {names[0]}: two logs must be of one robot")
    chosen: str = robot or names[0]
    joints = len(load_robot(chosen).joints)
    for path, log in zip(paths, logs, strict=True):
        if (count := len(log.record(0).observation.position)) != joints:
            raise ConfigError(f"{path}: its robot has {count} joints, {chosen} has {joints}")
    return chosen


class Player:
    """Shows ticks of a log, as people at the page ask, and beside them those of a second one."""

    def __init__(self, link: PageLink, logs: Sequence[LoggedTicks], robot: str) -> None:
        self._link, self._ticks = link, logs[0]
        self._other = logs[1] if len(logs) > 1 else None
        self._later = (
            0.0 if self._other is None else _begins(self._other) - _begins(self._ticks)
        )  # s, the second's task
        self._now, self._plays, self._shown = 0.0, True, -1
        self._became: PlanOutcome | None = None  # of the newest plan
        header, episode = self._ticks.header, self._ticks.header.get("episode") or {}
        path = episode.get("path")
        events = list(self._ticks.events)
        if self._other is not None:
            told = [
                replace(event, text=f"2: {event.text}", time=event.time - self._later) for event in self._other.events
            ]
            events = sorted([*events, *told], key=lambda event: event.time)
        self._info = RunInfo(
            robot=robot,
            title="; ".join(f"{log.header['task']['name']}, {log.header['started']}" for log in logs),
            backend=header["backend"],
            policy=" and ".join(dict.fromkeys(log.header["policy"]["name"] for log in logs)),
            simulated=False,  # the truth is in no log
            reach=episode.get("reach"),
            path=None if path is None else np.array(path, dtype=float),
            steers=False,
            insists=False,
            length=float(self._ticks.times[-1]),
            events=tuple(events),
        )
        self._begin(self._info)

    def _begin(self, info: RunInfo) -> None:
        self._snapshots = Snapshots(self._ticks.record(0).observation.time_ns)
        self._others = None if self._other is None else Snapshots(self._other.record(0).observation.time_ns)
        self._became = None
        self._link.begin(info)
        told = [_ended(log) for log in (self._ticks, self._other) if log is not None]
        if self._other is not None:
            told = [(told[0][0], f"1: {told[0][1]} 2: {told[1][1]}")] if all(text for _, text in told) else []
        for outcome, text in told:
            if text:
                self._link.end(outcome, text)

    def play(self) -> None:
        """Until there is no page any more."""
        before = time.monotonic()
        while self._link.alive:
            select.select([self._link], [], [], FRAME_SECONDS)
            now = time.monotonic()
            self.look(now - before)
            before = now

    def look(self, seconds: float = 0.0) -> None:
        """Heed what people ask, and show the moment that it is after so long."""
        self._heed()
        if self._plays:
            self._now = min(self._now + seconds, float(self._ticks.times[-1]))
        self._show()

    def _heed(self) -> None:
        if (request := self._link.take("play")) is not None:
            self._plays = request.on
            if self._now >= self._ticks.times[-1]:
                self._now = 0.0
        if (request := self._link.take("seek")) is not None:
            self._go(request.at)

    def _go(self, seconds: float) -> None:
        """To another moment: what came before it is sent along."""
        self._now = float(np.clip(seconds, 0.0, self._ticks.times[-1]))
        row, first = self._ticks.at(self._now), self._ticks.at(self._now - BEFORE)
        self._begin(replace(self._info, events=()))
        for earlier in range(first, row, EVERY):
            self._link.publish(self._snapshot(earlier))
            time.sleep(BREATH)  # the line holds some tens of them
        self._shown = -1

    def _show(self) -> None:
        row = self._ticks.at(self._now)
        if row != self._shown:
            self._shown = row
            self._link.publish(self._snapshot(row))

    def _snapshot(self, row: int) -> Snapshot:
        """A tick, with the second log's at that moment, and what came of its plan."""
        record = self._ticks.record(row)
        snapshot = self._snapshots.take(record, None, ())
        if record.proposal.plan is not None:
            self._became = self.outcome(row, record)
        if self._other is not None and self._others is not None:
            at = float(self._ticks.times[row]) + self._later
            if 0.0 <= at <= self._other.times[-1] + FRAME_SECONDS:
                other = self._others.take(self._other.record(self._other.at(at)), None, ())
                snapshot = replace(snapshot, other=other)
        return replace(snapshot, became=self._became)

    def outcome(self, row: int, record: TickRecord) -> PlanOutcome | None:
        """What came of a plan that was adopted at a tick: where the robot went, and by how much that was elsewhere."""
        adopted = record.proposal.plan
        assert adopted is not None
        plan, asked = adopted.plan, row - (adopted.adopted - adopted.requested)
        path = np.asarray(plan.path, dtype=float)
        ahead = np.arange(1, len(path) + 1) if plan.ticks is None else np.asarray(plan.ticks, dtype=int)
        known = (ahead + asked < len(self._ticks)) & (asked >= 0)
        start = self._ticks.record(asked).state if asked >= 0 else None
        if start is None or not known.any() or not np.isfinite(path).all():
            return None
        states = [self._ticks.record(int(asked + tick)).state for tick in ahead[known]]
        places = np.array([np.full(2, np.nan) if state is None else state.displacement[:2] for state in states])
        meant = start.displacement[:2] + turned(path, float(start.yaw))
        return PlanOutcome(places, float(np.linalg.norm(places[-1] - meant[known][-1])), float(ahead[known][-1]))


def _begins(log: LoggedTicks) -> float:
    """When a run's task begins [s from its first tick]; 0 where it never does."""
    return next((event.time for event in log.events if event.kind == "phase" and event.text.startswith("running")), 0.0)


def _ended(log: LoggedTicks) -> tuple[str, str]:
    """How a run ended, in a word and in a sentence."""
    if log.result is not None:
        return log.result["outcome"], f"How it ended: {log.result['outcome'].replace('_', ' ')}."
    return "cut short", "" if log.complete else "The log was cut short: it does not tell how the run ended."

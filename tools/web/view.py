"""Look at a recorded run on the operator's page, with a time line: play it, stop it, and go to any moment.

Prints the page's address and runs until Ctrl-C, or until the page is gone. Any log can be looked at, also one that was
cut short; nothing in it is changed.
"""

from __future__ import annotations

import argparse
import select
import time
from dataclasses import replace
from pathlib import Path

import numpy as np

from servoid.hw.robot.description import load_robot
from servoid.stack.log.look_back import LoggedTicks
from servoid.tools.common import exit_codes
from servoid.tools.common.output import add_json_argument, reporting
from servoid.tools.web.launch import add_view_arguments, open_page, view_of
from servoid.tools.web.line.link import PageLink
from servoid.tools.web.line.snapshot import RunInfo

FRAME_SECONDS = 1.0 / 30.0
BEFORE = 20.0  # s that are shown before the moment that somebody goes to
EVERY = 5  # of its ticks
BREATH = 0.002  # s


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("log", type=Path, metavar="LOG", help="flight log (.mcap)")
    parser.add_argument("--robot", metavar="NAME|FILE", help="robot to draw (default: the log's)")
    add_view_arguments(parser, switch=False)
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        ticks = LoggedTicks(args.log)
        name = args.robot or ticks.header["settings"]["robot"]
        load_robot(name)
        with open_page(view_of(args), name) as page:
            report.line(f"page: {page.url}")
            try:
                Player(page.link, ticks, name).play()
            except KeyboardInterrupt:
                report.line("ended by Ctrl-C")
        report.result({"log": args.log, "ticks": len(ticks), "complete": ticks.complete})
    return exit_codes.DONE


class Player:
    """Shows ticks of a log, as people at the page ask."""

    def __init__(self, link: PageLink, ticks: LoggedTicks, robot: str) -> None:
        self._link, self._ticks = link, ticks
        self._now, self._plays, self._shown = 0.0, True, -1
        header, episode = ticks.header, ticks.header.get("episode") or {}
        path = episode.get("path")
        self._info = RunInfo(
            robot=robot,
            title=f"{header['task']['name']}, {header['started']}",
            backend=header["backend"],
            policy=header["policy"]["name"],
            simulated=False,  # the truth is in no log
            reach=episode.get("reach"),
            path=None if path is None else np.array(path, dtype=float),
            steers=False,
            insists=False,
            length=float(ticks.times[-1]),
            events=tuple(ticks.events),
        )
        self._start_ns = ticks.record(0).observation.time_ns
        self._begin(self._info)

    def _begin(self, info: RunInfo) -> None:
        ticks, link = self._ticks, self._link
        link.begin(info, start_ns=self._start_ns)
        if ticks.result is not None:
            link.end(ticks.result["outcome"], f"How it ended: {ticks.result['outcome'].replace('_', ' ')}.")
        elif not ticks.complete:
            link.end("cut short", "The log was cut short: it does not tell how the run ended.")

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
            self._link(self._ticks.record(earlier))
            time.sleep(BREATH)  # the line holds some tens of them
        self._shown = -1

    def _show(self) -> None:
        row = self._ticks.at(self._now)
        if row != self._shown:
            self._shown = row
            self._link(self._ticks.record(row))

"""Stop a walk at the page at random instants, and lose whoever steers: how soon it rests, and torque is off.

The stops are of walks on a virtual rig in simulated time, over the page's own line: from the tick at which the page
says stop until the robot is brought to rest, and until every servo has taken torque off. The losses are of a walk in
simulation in real time, steered over the page by a client that stands for a browser: it is killed, frozen as on a
laptop that falls asleep, or cut off from the page, and from then until the task asks for rest is measured.
"""

from __future__ import annotations

import argparse
import random
import signal
import socket
import subprocess
import sys
import threading
import time
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.operator import Intent
from servoid.hw.robot.description import load_robot
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.operator import Operator
from servoid.stack.runtime.run import RunSettings, run
from servoid.stack.safety.phase import Phase
from servoid.tools.common import exit_codes
from servoid.tools.common.output import Report, add_json_argument, reporting
from servoid.tools.web.launch import OpenPage, View, check_installed, open_page
from servoid.tools.web.line.link import PageLink
from servoid.tools.web.line.messages import PageRequest
from servoid.tools.web.line.snapshot import RunInfo

SPAN_SECONDS = 3.0  # of a walk in which the stops lie
WAYS = ("killed", "asleep", "cut off")
WALK_SECONDS = (0.5, 1.0)  # from when somebody steers until they are lost
OFTEN = 50  # ticks between two questions to the rig


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument(
        "--stops", type=int, default=100, metavar="N", help="walks to be stopped (default: %(default)s)"
    )
    parser.add_argument("--losses", type=int, default=20, metavar="N", help="losses each way (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: %(default)s)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    with reporting(args.json) as report:
        if args.stops < 0 or args.losses < 0:
            raise ConfigError(f"--stops {args.stops} --losses {args.losses}: must not be negative")
        check_installed()
        result: dict[str, Any] = {}
        if args.stops:
            result |= summarise_stops(stops(report, args.stops, args.seed))
        if args.losses:
            with open_page(View(port=0), "op3") as page:
                for way in WAYS:
                    found = Losses(page, way, args.losses, random.Random(f"{args.seed} {way}")).measure()
                    result[f"{way.replace(' ', '_')}_rest_ms_worst"] = round(1e3 * max(found))
                    result[f"{way.replace(' ', '_')}_rest_ms_median"] = round(1e3 * float(np.median(found)))
                    report.line(f"{way}: rest after {', '.join(f'{1e3 * seconds:.0f}' for seconds in found)} ms")
        report.table(["figure", "value"], [[key, value] for key, value in result.items()])
        report.result(result)
    return exit_codes.DONE


# --- stops


def stops(report: Report, times: int, seed: int) -> list[dict[str, Any]]:
    """A row for each walk that was stopped. An instant depends on its number alone."""
    from servoid.sim.rig.process.control import RigProcess
    from servoid.sim.rig.servo.board import on_the_board

    rows, robot = [], load_robot()
    with RigProcess(on_the_board(robot)) as rig:
        for number in range(times):
            row = stop(rig, random.Random(f"{seed} {number}").uniform(0.0, SPAN_SECONDS))
            report.line(f"{number}: " + ", ".join(f"{key} {value}" for key, value in row.items()))
            rows.append(row)
    return rows


def stop(rig: Any, at: float) -> dict[str, Any]:
    """One walk, stopped `at` s after its first step."""
    from servoid.hw.dynamixel.backend import DynamixelBackend
    from servoid.sim.rig.process.control import LockedClock
    from servoid.sim.rig.servo.board import on_the_board

    rig.control.reset(0)
    rig.control.accepted()
    robot = load_robot()
    body = DynamixelBackend(on_the_board(robot), port=rig.port, clock=LockedClock(rig.control), name="virtual")
    pressed = Pressed(rig, round(at * robot.rate))
    settings = RunSettings("walk", backend="dynamixel", policy="gait", seconds=60.0, start=True, realtime=False)
    link, page = pressed.line()
    with page:
        result = run(
            replace(settings, set={"vx": "0.1", "vy": "0", "yaw_rate": "0"}),
            backend=body,
            on_tick=pressed,
            operator=Operator(link, held=False),
        )
        link.close()
    pressed.look()
    begun, lowering = pressed.first(Phase.STOPPING), pressed.first(Phase.LOWERING)
    off = max(pressed.off.values(), default=0)
    return {
        "at_s": round(at, 2),
        "outcome": result.outcome,
        "rest_ticks": None if begun is None or pressed.pressed is None else begun[0] - pressed.pressed,
        "lowering_s": None if lowering is None else round((off - lowering[1]) * 1e-9, 3),
        "all_off": len(pressed.off) == len(robot.joints) and not any(s["torque"] for s in rig.control.servos()),
    }


class Pressed:
    """Listens to a run, says stop over the page's line at a tick of its walk, and remembers what came of it."""

    def __init__(self, rig: Any, at: int) -> None:
        self._rig, self._at = rig, at
        self._walked = 0
        self.pressed: int | None = None  # tick
        self.off: dict[int, int] = {}  # joint -> ns of the rig, when it took torque off
        self._phases: dict[Phase, tuple[int, int]] = {}

    def line(self) -> tuple[PageLink, socket.socket]:
        ours, self._page = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        return PageLink(ours), self._page

    def __call__(self, record: TickRecord) -> None:
        self._phases.setdefault(record.phase, (record.tick, record.observation.time_ns))
        if record.phase is Phase.RUNNING:
            self._walked += 1
            if self._walked > self._at and self.pressed is None:
                self.pressed = record.tick
                self._page.send(PageRequest("stop", 1, 0.0).encode())
        if record.tick % OFTEN == 0:
            self.look()

    def first(self, phase: Phase) -> tuple[int, int] | None:
        """Tick and time [ns] at which a phase began."""
        return self._phases.get(phase)

    def look(self) -> None:
        """Ask the rig what its servos took since the last look."""
        for entry in self._rig.control.accepted():
            if entry["register"] == "torque_enable":
                if entry["value"]:
                    self.off.pop(entry["joint"], None)
                else:
                    self.off[entry["joint"]] = entry["time_ns"]


def summarise_stops(rows: list[dict[str, Any]]) -> dict[str, Any]:
    lowered = [row["lowering_s"] for row in rows if row["lowering_s"] is not None]
    rested = [row["rest_ticks"] for row in rows if row["rest_ticks"] is not None]
    return {
        "stops": len(rows),
        "stopped_by_the_page": sum(row["outcome"] == "interrupted" for row in rows),
        "all_off": sum(row["all_off"] for row in rows),
        "rest_ticks_worst": max(rested, default=None),
        "lowered": len(lowered),
        "lowering_s_worst": max(lowered, default=None),
    }


# --- losses


@dataclass
class Sender:
    """Whoever steers, in a process of its own. `wire` is the cable between them and the page."""

    process: subprocess.Popen[str]
    wire: Cable

    @classmethod
    def connect(cls, url: str) -> Sender:
        wire = Cable(int(url.rstrip("/").rsplit(":", 1)[1]))
        line = [sys.executable, "-m", "servoid.tools.faults.sender", url, str(wire.port)]
        process = subprocess.Popen(line, stdin=subprocess.PIPE, stdout=subprocess.PIPE, text=True)
        assert process.stdout is not None
        process.stdout.readline()
        return cls(process, wire)

    def go(self) -> None:
        assert self.process.stdin is not None
        self.process.stdin.write("go\n")
        self.process.stdin.flush()

    def close(self) -> None:
        self.process.kill()
        self.process.communicate()
        self.wire.close()


@dataclass
class Losses:
    """Loses whoever steers, so many times in one `way`, while the robot walks on."""

    page: OpenPage
    way: str
    times: int
    dice: random.Random
    found: list[float] = field(default_factory=list)  # s until rest
    _since: float | None = None  # s, when the robot was first seen to walk this time
    _lost: float | None = None  # s, when its person was lost
    _wait: float = 0.0

    def measure(self) -> list[float]:
        """Seconds from each loss until the task asked for rest."""
        while len(self.found) < self.times:
            self._since = self._lost = None
            self._senders = [Sender.connect(self.page.url) for _ in range(2)]  # one waits: who is killed comes not back
            link = self.page.link
            link.take("start")
            link.begin(RunInfo("op3", f"steer, {self.way}", "sim", "gait", simulated=True, insists=False))
            self._senders[0].go()
            try:
                settings = RunSettings("steer", policy="gait", seconds=3600.0, realtime=True)
                run(settings, on_tick=self, operator=Operator(Ending(link, self)))
            finally:
                for sender in self._senders:
                    sender.close()
        return self.found

    @property
    def done(self) -> bool:
        return len(self.found) >= self.times

    def __call__(self, record: TickRecord) -> None:
        asked, now = record.proposal.instruction, time.monotonic()
        self.page.link(record)
        if asked is None or self.done:
            return
        walks = bool(asked.velocity.any())
        if self._lost is not None:
            if not walks:
                self.found.append(now - self._lost)
                self._come_back()
        elif not walks:
            self._since = None
        elif self._since is None:
            self._since, self._wait = now, self.dice.uniform(*WALK_SECONDS)
        elif now - self._since > self._wait:
            self._lose()
            self._lost = time.monotonic()

    def _lose(self) -> None:
        sender = self._senders[0]
        if self.way == "cut off":
            sender.wire.open.clear()
        else:
            sender.process.send_signal(signal.SIGKILL if self.way == "killed" else signal.SIGSTOP)

    def _come_back(self) -> None:
        self._lost = self._since = None
        sender = self._senders[0]
        if self.way == "cut off":
            sender.wire.open.set()
        elif self.way == "asleep":
            sender.process.send_signal(signal.SIGCONT)
        else:
            threading.Thread(target=self._relieve, daemon=True).start()

    def _relieve(self) -> None:
        """The one who waits takes over, and another one comes to wait."""
        gone, waiting = self._senders
        waiting.go()
        gone.close()
        self._senders = [waiting, Sender.connect(self.page.url)]


class Ending:
    """The page's person, who ends the task once enough was measured."""

    def __init__(self, link: PageLink, losses: Losses) -> None:
        self._link, self._losses = link, losses

    def read(self) -> Intent:
        return replace(self._link.read(), ends=self._losses.done)

    def close(self) -> None:
        """The page stays for the next walk."""


class Cable:
    """A cable to a port of this machine that carries nothing while it is not `open`, and tells neither end."""

    def __init__(self, to: int) -> None:
        self.open = threading.Event()
        self.open.set()
        self._to, self._server = to, socket.create_server(("127.0.0.1", 0))
        self.port: int = self._server.getsockname()[1]
        self._ends: list[socket.socket] = [self._server]
        threading.Thread(target=self._accept, daemon=True).start()

    def close(self) -> None:
        self.open.set()
        for end in self._ends:
            end.close()

    def _accept(self) -> None:
        while True:
            try:
                near, _ = self._server.accept()
            except OSError:  # closed
                return
            far = socket.create_connection(("127.0.0.1", self._to))
            self._ends += [near, far]
            for ways in ((near, far), (far, near)):
                threading.Thread(target=self._pour, args=ways, daemon=True).start()

    def _pour(self, source: socket.socket, sink: socket.socket) -> None:
        try:
            while data := source.recv(65536):
                self.open.wait()
                sink.sendall(data)
        except OSError:  # an end was closed
            pass
        for end in (source, sink):
            try:
                end.shutdown(socket.SHUT_RDWR)
            except OSError:
                continue

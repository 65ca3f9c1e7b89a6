"""The page's process: `python -m servoid.tools.web.browser.process SETTINGS`, which are JSON.

It reads what the loop publishes and passes on what people ask. The loop never waits for it; when the loop's program has
ended, or died, pages are told so, and this ends a little later. First it prints one line of JSON: `url`, or `error`.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import os
import pickle
import signal
import socket
import sys
import tempfile
import time
from dataclasses import dataclass, replace
from pathlib import Path
from typing import Any

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import load_robot
from servoid.stack.safety.phase import Phase
from servoid.tools.web.browser.access import Access
from servoid.tools.web.browser.gate import Gate
from servoid.tools.web.browser.live_foxglove import LiveFoxglove
from servoid.tools.web.browser.rights import Rights
from servoid.tools.web.browser.scene import Scene3D
from servoid.tools.web.browser.server import PageServer
from servoid.tools.web.browser.telemetry import ENDING, Telemetry
from servoid.tools.web.line.messages import HALTS, PageRequest
from servoid.tools.web.line.snapshot import Snapshot

LONGEST = 1 << 20  # bytes of a message of the loop
NICE = 5  # the loop goes first where they share a core
PICTURE_SECONDS = 1.0 / 30.0
DEAF_SECONDS = 0.5  # after which a loop that does not heed a wish to stop is sent the signal of Ctrl-C
FAREWELL_SECONDS = 0.5  # that pages stay after the loop's program has ended


@dataclass(frozen=True)
class PageSettings:
    """What the process is started with. `fd` is its end of the line to the loop."""

    fd: int
    robot: str
    host: str
    port: int
    token: str | None
    foxglove: int | None  # port for Foxglove's application; None: not served
    tasks: list[dict[str, str]]  # that may be started from the page: name, description


class PageProcess:
    """Joins the loop, the numbers, the picture and the browsers."""

    def __init__(self, settings: PageSettings) -> None:
        """Raises ConfigError for a robot that cannot be drawn."""
        robot = load_robot(settings.robot)
        self._settings = settings
        self._stream = socket.socket(fileno=settings.fd)
        self._stream.setblocking(False)
        self._telemetry, self._rights = Telemetry(robot), Rights(settings.token)
        self._scene = Scene3D(robot, self._switch_truth, self._drag)
        self._foxglove = None if settings.foxglove is None else LiveFoxglove(robot, settings.foxglove)
        self._server = PageServer(self._telemetry, self._rights, self._pass)
        self._server.tasks = settings.tasks
        self._newest: Snapshot | None = None
        self._numbers = ""  # of it, as JSON
        self._plan: Array | None = None  # (n, 2) m: the newest one's path
        self._phase: str | None = None  # of the newest tick of what runs; None: nothing runs
        self._halted: float | None = None  # s, when somebody asked to stop and was not heeded yet
        self._insists = True
        self._signals = 0  # that were sent for it
        self._parent = os.getppid()
        self._ended = asyncio.Event()
        self._loop = asyncio.get_running_loop()

    async def run(self) -> None:
        access = Access(self._settings.host, self._settings.token)
        with tempfile.TemporaryDirectory(prefix="servoid-page-") as folder:
            path = Path(folder) / "page"
            inner = await self._server.listen(path)
            gate = Gate(access, path, self._scene.port)
            try:
                await gate.listen(self._settings.port)
            except OSError as error:
                raise ConfigError(
                    f"the page cannot be at {self._settings.host}, port {self._settings.port}: "
                    f"{os.strerror(error.errno or 0)}: "
                    "choose another with --view-port, or --view-host"
                ) from None
            served = None if self._foxglove is None else self._foxglove.url
            print(json.dumps({"url": access.url(gate.port), "foxglove": served}), flush=True)
            self._loop.add_reader(self._stream.fileno(), self._receive)
            drawing = asyncio.create_task(self._draw())
            await self._ended.wait()
            await asyncio.sleep(FAREWELL_SECONDS)
            drawing.cancel()
            inner.close()
            self._scene.close()
            if self._foxglove is not None:
                self._foxglove.close()

    def _receive(self) -> None:
        while True:
            try:
                data = self._stream.recv(LONGEST)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self._loop.remove_reader(self._stream.fileno())
                self._server.gone = "The program that controlled the robot has ended."
                self._phase = None
                self._ended.set()
                return
            kind, value = pickle.loads(data)  # of our own program
            self._take(kind, value)

    def _take(self, kind: str, value: Any) -> None:
        """Take up what the loop has told."""
        if kind == "tick":
            self._plan = self._plan if value.plan is None else value.plan
            self._newest, self._phase = replace(value, plan=self._plan), value.phase
            self._numbers = self._telemetry.tick(self._newest)
            self._server.show(self._numbers)
            if self._foxglove is not None:
                for event in value.events:
                    self._foxglove.hear(event)
            if value.phase in ENDING:
                self._halted = None
        elif kind == "run":
            self._telemetry.begin(value)
            for event in value.events:
                self._telemetry.hear(event)
            self._scene.begin(value)
            self._phase, self._plan, self._insists = Phase.LIMP, None, value.insists
            self._server.renew()
        elif kind == "panel":
            self._server.panel = json.dumps(value or {"kind": "panel"}, allow_nan=False)
        elif kind == "end":
            self._telemetry.end(*value)
            self._phase = self._halted = None
            self._server.renew()

    def _pass(self, request: PageRequest) -> None:
        """Send a request on to the loop. A full line means that the loop reads nothing."""
        with contextlib.suppress(OSError):
            self._stream.send(request.encode())
        if request.kind in HALTS and self._phase is not None and self._halted is None:
            self._halted, self._signals = time.monotonic(), 0

    def _switch_truth(self, on: bool) -> None:
        """Called by viser, in a thread of its own."""
        request = PageRequest("truth", 0, 0.0, on=on)
        self._loop.call_soon_threadsafe(lambda: self._pass(self._rights.numbered(request)))

    def _drag(self, name: str, place: Array) -> None:
        """Called by viser, in a thread of its own, which does not say whose browser it was: somebody has to be in
        control."""
        value = " ".join(f"{part:.4f}" for part in place)
        request = PageRequest("do", 0, 0.0, what=f"drag {name}", value=value)

        def passed() -> None:
            if self._rights.holder is not None:
                self._pass(self._rights.numbered(request))

        self._loop.call_soon_threadsafe(passed)

    async def _draw(self) -> None:
        """Draw the newest tick, as often as a picture is due, and see to it that a wish to stop is heeded."""
        drawn: Snapshot | None = None
        while True:
            await asyncio.sleep(PICTURE_SECONDS)
            if self._newest is not None and self._newest is not drawn:
                drawn = self._newest
                self._scene.show(drawn)
                if self._foxglove is not None:
                    self._foxglove.show(drawn, self._numbers)
            self._insist()

    def _insist(self) -> None:
        """Where the loop hangs, a signal is what ends it: one is a request, the second breaks off what hangs."""
        if self._halted is None or self._phase is None or not self._insists or os.getppid() != self._parent:
            return
        if time.monotonic() - self._halted > DEAF_SECONDS * (self._signals + 1) and self._signals < 2:
            self._signals += 1
            os.kill(self._parent, signal.SIGINT)


async def _main(settings: PageSettings) -> None:
    await PageProcess(settings).run()


def main() -> int:
    os.nice(NICE)
    for number in (signal.SIGINT, signal.SIGHUP, signal.SIGTSTP, signal.SIGQUIT):
        signal.signal(number, signal.SIG_IGN)  # those of the terminal are the loop's, which hangs up when it is done
    try:
        asyncio.run(_main(PageSettings(**json.loads(sys.argv[1]))))
    except ConfigError as error:
        print(json.dumps({"error": str(error)}), flush=True)
        return 2
    return 0


if __name__ == "__main__":
    sys.exit(main())

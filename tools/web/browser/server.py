"""The page's own server: its files, and a connection to each browser, over which numbers go and requests come.

A browser that takes its frames slowly gets fewer of them, and holds up nobody.
"""

from __future__ import annotations

import asyncio
import contextlib
import http
import json
import time
from collections.abc import Callable
from itertools import count
from pathlib import Path

from websockets.asyncio.server import Server, ServerConnection, unix_serve
from websockets.datastructures import Headers
from websockets.exceptions import ConnectionClosed
from websockets.http11 import Request as HttpRequest
from websockets.http11 import Response

from servoid.tools.web.browser.rights import NotHeeded, Rights
from servoid.tools.web.browser.telemetry import Telemetry
from servoid.tools.web.line.messages import LONGEST, PageRequest

STATIC = Path(__file__).with_name("static")
FILES = {
    "/": ("index.html", "text/html; charset=utf-8"),
    "/page.js": ("page.js", "text/javascript; charset=utf-8"),
    "/draw.js": ("draw.js", "text/javascript; charset=utf-8"),
    "/panel.js": ("panel.js", "text/javascript; charset=utf-8"),
    "/page.css": ("page.css", "text/css; charset=utf-8"),
}
FRAME_SECONDS = 0.05  # between two frames of numbers
SILENT_SECONDS = 60.0  # without a word from a browser, until its connection is given up


class PageServer:
    """Serves at the socket `path`. `passed` gets each request that is to go on to the loop."""

    def __init__(self, telemetry: Telemetry, control: Rights, passed: Callable[[PageRequest], None]) -> None:
        self._telemetry, self._rights, self._passed = telemetry, control, passed
        self._numbers = count()
        self._frame, self._version = "", 0  # the newest frame, and how many there were
        self._begun = 0  # how many runs have begun or ended
        self.tasks: list[dict[str, str]] = []  # that can be started from here
        self.panel = ""  # the newest one, as JSON; none where the program has none
        self.gone: str | None = None  # why no more comes

    async def listen(self, path: Path) -> Server:
        return await unix_serve(
            self._serve, str(path), process_request=self._file, max_size=LONGEST, compression=None, max_queue=16
        )

    def show(self, frame: str) -> None:
        """The newest frame of numbers."""
        self._frame, self._version = frame, self._version + 1

    def renew(self) -> None:
        """A run has begun or ended: pages are told anew what it is."""
        self._begun += 1

    def _file(self, connection: ServerConnection, request: HttpRequest) -> Response | None:
        """A file of the page; None for the connection that stays open."""
        if request.path == "/control":
            return None
        if request.path not in FILES:
            return connection.respond(http.HTTPStatus.NOT_FOUND, "there is no such page\n")
        name, kind = FILES[request.path]
        body = (STATIC / name).read_bytes()
        headers = Headers(
            {
                "Content-Type": kind,
                "Content-Length": str(len(body)),
                "Cache-Control": "no-store",
                "Referrer-Policy": "no-referrer",  # the address holds the token
                "Connection": "close",
                # No other site may lay this page under its own buttons.
                "Content-Security-Policy": "default-src 'self'; img-src 'self' data:; frame-ancestors 'self'",
            }
        )
        return Response(200, "OK", headers, body)

    async def _serve(self, connection: ServerConnection) -> None:
        who = next(self._numbers)
        self._rights.come(who)
        telling = asyncio.create_task(self._tell(who, connection))
        try:
            while True:
                data = await asyncio.wait_for(connection.recv(), SILENT_SECONDS)
                try:
                    request = self._rights.hear(who, data, time.monotonic())
                except NotHeeded as error:
                    await connection.send(json.dumps({"kind": "refused", "text": str(error)}))
                    continue
                if request is not None:
                    self._passed(request)
        except (ConnectionClosed, TimeoutError):
            pass
        finally:
            self._rights.leave(who)
            telling.cancel()
            with contextlib.suppress(asyncio.CancelledError, ConnectionClosed):
                await telling

    async def _tell(self, who: int, connection: ServerConnection) -> None:
        """Send a browser what is new, as quickly as it takes it."""
        begun, shown, event, stands, panel = -1, 0, 0, "", ""
        while True:
            if begun != self._begun:
                begun = self._begun
                await connection.send(self._telemetry.hello())
            for number, text in list(self._telemetry.events):
                if number > event:
                    event = number
                    await connection.send(text)
            if shown != self._version:
                shown = self._version
                await connection.send(self._frame)
            if panel != self.panel:
                panel = self.panel
                await connection.send(panel)
            if stands != (now := self._standing(who)):
                stands = now
                await connection.send(now)
            await asyncio.sleep(FRAME_SECONDS)

    def _standing(self, who: int) -> str:
        """How a browser stands towards the others, and its robot's program."""
        control = self._rights
        held = "nobody" if control.holder is None else "you" if control.holder == who else "other"
        return json.dumps(
            {"kind": "control", "holder": held, "people": control.people, "tasks": self.tasks, "gone": self.gone}
        )

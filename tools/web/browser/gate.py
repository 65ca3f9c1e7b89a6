"""The page's one door: it looks at each connection's first request, and joins the connection to what that asks for.

Behind it, and not to be reached from elsewhere, are the page itself (a socket in a private folder) and viser (a port of
this machine). Each of them answers one request a connection, so that nothing passes unseen behind the first.
"""

from __future__ import annotations

import asyncio
import contextlib
from pathlib import Path

from servoid.tools.web.browser.access import Access

HEAD_SECONDS = 5.0  # for a request: whoever is slower is gone
LONGEST_HEAD = 16384  # bytes
MOST = 64  # connections: each viewer has two
CHUNK = 65536
VIEW = "/viser"


class Gate:
    """Joins connections to the page at the socket `page`, or to viser at `viser_port`."""

    def __init__(self, access: Access, page: Path, viser_port: int) -> None:
        self._access, self._page, self._viser = access, page, viser_port
        self._port, self._open = 0, 0

    async def listen(self, port: int) -> asyncio.Server:
        """Raises OSError where the port or the host cannot be had."""
        server = await asyncio.start_server(self._serve, self._access.host, port, limit=LONGEST_HEAD)
        self._port = server.sockets[0].getsockname()[1]
        return server

    @property
    def port(self) -> int:
        return self._port

    async def _serve(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        self._open += 1
        try:
            if self._open > MOST:
                await _refuse(writer, "503 Service Unavailable", "too many connections")
            else:
                await self._answer(reader, writer)
        except (OSError, asyncio.IncompleteReadError, asyncio.LimitOverrunError, TimeoutError):
            pass  # somebody went away, or sent no request: nobody else needs to know
        except asyncio.CancelledError:
            pass  # the page ends, and all that is open with it
        finally:
            self._open -= 1
            writer.close()

    async def _answer(self, reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
        head = await asyncio.wait_for(reader.readuntil(b"\r\n\r\n"), HEAD_SECONDS)
        line, *lines = head.decode("latin-1").split("\r\n")
        words = line.split(" ")
        if len(words) != 3 or words[0] not in ("GET", "HEAD"):
            await _refuse(writer, "400 Bad PageRequest", "the page only answers GET")
            return
        headers = {name.strip().lower(): value.strip() for name, _, value in (text.partition(":") for text in lines)}
        try:
            path = self._access.path(words[1], headers, self._port)
        except PermissionError as error:
            await _refuse(writer, "403 Forbidden", str(error))
            return
        if path == VIEW or path.startswith(VIEW + "/"):
            path = path.removeprefix(VIEW) or "/"
            other = await asyncio.open_connection("127.0.0.1", self._viser)
        else:
            other = await asyncio.open_unix_connection(str(self._page))
        other[1].write("\r\n".join([f"{words[0]} {path} {words[2]}", *lines]).encode("latin-1"))
        ways = [_pour(reader, other[1]), _pour(other[0], writer)]
        tasks = [asyncio.create_task(way) for way in ways]
        try:
            await asyncio.wait(tasks, return_when=asyncio.FIRST_COMPLETED)
        finally:
            other[1].close()
            for task in tasks:
                task.cancel()
            await asyncio.gather(*tasks, return_exceptions=True)


async def _pour(reader: asyncio.StreamReader, writer: asyncio.StreamWriter) -> None:
    with contextlib.suppress(OSError):
        while data := await reader.read(CHUNK):
            writer.write(data)
            await writer.drain()


async def _refuse(writer: asyncio.StreamWriter, status: str, text: str) -> None:
    body = f"{text}\n".encode()
    head = f"HTTP/1.1 {status}\r\nContent-Type: text/plain\r\nContent-Length: {len(body)}\r\nConnection: close\r\n\r\n"
    writer.write(head.encode() + body)
    await writer.drain()

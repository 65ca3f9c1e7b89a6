"""Somebody at the operator's page, without a browser: takes control and pushes the stick forward, as the page does.

    python -m servoid.tools.faults.sender URL PORT

Connects to URL over PORT of this machine, prints a line, and begins with the first line of standard input; the next one
ends it.
"""

from __future__ import annotations

import asyncio
import contextlib
import json
import sys
import time
from itertools import count
from typing import Any

from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed

BEAT_SECONDS = 0.05  # as page.js


async def _drain(connection: Any) -> None:
    """Take what the page tells: whoever takes nothing is held up."""
    with contextlib.suppress(ConnectionClosed):
        async for _ in connection:
            pass


async def _main(url: str, port: int) -> None:
    address = url.replace("http", "ws", 1) + "control"
    loop = asyncio.get_running_loop()
    async with connect(address, origin=url.rstrip("/"), host="127.0.0.1", port=port, proxy=None) as connection:  # type: ignore[arg-type]
        draining = asyncio.create_task(_drain(connection))
        print("connected", flush=True)
        await loop.run_in_executor(None, sys.stdin.readline)
        ended = loop.run_in_executor(None, sys.stdin.readline)
        for number in count(1):
            request: dict[str, Any] = {"kind": "take" if number % 10 == 1 else "beat"}
            if request["kind"] == "beat":
                request["way"] = [0.5, 0.0, 0.0]
            await connection.send(json.dumps(request | {"sequence": number, "time": time.monotonic()}))
            if ended.done():
                break
            await asyncio.sleep(BEAT_SECONDS)
        draining.cancel()


if __name__ == "__main__":
    with contextlib.suppress(ConnectionClosed):
        asyncio.run(_main(sys.argv[1], int(sys.argv[2])))

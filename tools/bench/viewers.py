"""Viewers of the operator's page without a browser: they take all that a browser would, and draw nothing.

    python -m servoid.tools.bench.viewers URL N

Prints a line once all of them have been sent something, and how much they took when standard input ends.
"""

from __future__ import annotations

import asyncio
import sys
from importlib import metadata

from websockets.asyncio.client import connect
from websockets.exceptions import ConnectionClosed
from websockets.typing import Subprotocol


async def _watch(address: str, origin: str, subprotocol: str | None, taken: list[int], first: asyncio.Event) -> None:
    """Take all messages of a connection: their number and their bytes."""
    protocols = None if subprotocol is None else [Subprotocol(subprotocol)]
    async with connect(address, origin=origin, subprotocols=protocols, max_size=None, proxy=None) as connection:  # type: ignore[arg-type]
        try:
            async for message in connection:
                taken[0] += 1
                taken[1] += len(message)
                first.set()
        except ConnectionClosed:
            pass


async def _main(url: str, viewers: int) -> None:
    base, origin = url.replace("http", "ws", 1), url.rstrip("/")
    pictures, numbers, begun, tasks = [0, 0], [0, 0], [], []
    for _ in range(viewers):
        for address, subprotocol, taken in (
            (base + "viser", f"viser-v{metadata.version('viser')}", pictures),
            (base + "control", None, numbers),
        ):
            first = asyncio.Event()
            begun.append(first.wait())
            tasks.append(asyncio.create_task(_watch(address, origin, subprotocol, taken, first)))
    await asyncio.gather(*begun)
    print("watching", flush=True)
    await asyncio.get_running_loop().run_in_executor(None, sys.stdin.read)
    for task in tasks:
        task.cancel()
    await asyncio.gather(*tasks, return_exceptions=True)
    print(*pictures, *numbers, flush=True)


if __name__ == "__main__":
    asyncio.run(_main(sys.argv[1], int(sys.argv[2])))

"""The line between a loop and a page that a test is."""

from __future__ import annotations

import pickle
import socket

from servoid.tools.web.line.link import PageLink
from servoid.tools.web.line.messages import PageRequest


class Line:
    """A link, the page's end of its line, and a clock that stands still."""

    def __init__(self) -> None:
        ours, self.page = socket.socketpair(socket.AF_UNIX, socket.SOCK_SEQPACKET)
        self.now = 0
        self.link = PageLink(ours, clock=lambda: self.now)
        self._sequence = 0
        self.page.setblocking(False)

    def ask(self, kind: str, **fields: object) -> None:
        self._sequence += 1
        self.page.send(PageRequest(kind, self._sequence, 0.0, **fields).encode())  # type: ignore[arg-type]

    def told(self) -> list[tuple[str, object]]:
        """All that has arrived."""
        arrived = []
        while True:
            try:
                arrived.append(pickle.loads(self.page.recv(1 << 20)))
            except BlockingIOError:
                return arrived

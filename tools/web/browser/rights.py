"""Who is in control: one person at a time; the others look on. Anyone who sees the page may stop the robot."""

from __future__ import annotations

import math
from dataclasses import dataclass, replace

from servoid.tools.web.line.messages import OPEN, PageRequest, parse_request

LATE = 0.3  # s that a request may have been on its way longer than the quickest of its sender: then nobody is there now
LOST = 2.0  # s without a word from whoever is in control, until somebody else may take it


class NotHeeded(ValueError):
    """A request that is not heeded; the text tells its sender why."""


@dataclass
class Visitor:
    """Somebody at a page."""

    sequence: int = -1  # of the newest request
    quickest: float = math.inf  # s between our clock and the sender's, for the request that was quickest
    heard: float = -math.inf  # s, our clock


class Rights:
    """Hears what people at pages ask, and lets through what they may. Times are s of a clock that never goes back."""

    def __init__(self, token: str | None) -> None:
        self._token = token
        self._people: dict[int, Visitor] = {}
        self._sequence = 0
        self.holder: int | None = None

    @property
    def people(self) -> int:
        """How many look on, or are in control."""
        return len(self._people)

    def come(self, who: int) -> None:
        self._people[who] = Visitor()

    def leave(self, who: int) -> None:
        """Their connection is gone."""
        self._people.pop(who, None)
        if self.holder == who:
            self.holder = None

    def hear(self, who: int, data: bytes | str, now: float) -> PageRequest | None:
        """What is to be passed on of a message that came at `now`; None: nothing. Raises NotHeeded."""
        person = self._people[who]
        try:
            request = parse_request(data, token=self._token)
        except ValueError as error:
            raise NotHeeded(str(error)) from None
        if request.sequence <= person.sequence:
            raise NotHeeded("older than the request before")
        person.sequence = request.sequence
        delay = now - request.time
        person.quickest = min(person.quickest, delay)
        if request.kind not in OPEN and delay - person.quickest > LATE:
            raise NotHeeded("too long on its way")
        if request.kind == "take":
            self._take(who, now)
        elif request.kind not in OPEN and self.holder != who:
            raise NotHeeded("take control first")
        elif request.kind == "release":
            self.holder = None
        person.heard = now
        if request.kind in ("look", "take", "release"):
            return None
        return self.numbered(request)

    def numbered(self, request: PageRequest) -> PageRequest:
        """A request as it goes on to the loop: with the next number of all that do."""
        self._sequence += 1
        return replace(request, sequence=self._sequence)

    def _take(self, who: int, now: float) -> None:
        holder = None if self.holder is None else self._people[self.holder]
        if holder is not None and self.holder != who and now - holder.heard < LOST:
            raise NotHeeded("somebody else is in control")
        self.holder = who

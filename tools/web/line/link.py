"""The loop's end of the line to the page's process: it publishes copies, and hears what people ask.

Nothing here waits. A snapshot that the page does not take is dropped, its events kept for the next one; when the page
dies, nothing is sent any more and the run goes on. What a page sends is data (tools/web/line/messages.py), checked once
more here: a page that is not itself any more cannot do more than a person at it.
"""

from __future__ import annotations

import contextlib
import math
import pickle
import socket
import time
from collections import deque
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from servoid.hw.contracts.operator import Halt, Intent
from servoid.hw.contracts.world import Truth
from servoid.stack.log.tick import TickRecord
from servoid.stack.safety.event import Event
from servoid.tools.web.line.messages import HALTS, LONGEST, OPEN, PageRequest, parse_request
from servoid.tools.web.line.panel import Panel
from servoid.tools.web.line.snapshot import RunInfo, Snapshot, Snapshots

ROOM = 1 << 20  # bytes on the way to the page: some hundred ticks
MOST = 64  # requests that are read in one tick: a page that floods waits its turn
TAKEN = {"start", "seek", "play"}  # kinds of wishes that are no part of what is wanted of a run
KEPT = 1000  # events that wait for a page which takes nothing
MOST_ACTIONS = 256  # that wait for a program which takes none


class PageLink:
    """The page of this program. Call it with each tick; read what the person at it wants: it is a `CommandSource`.

    Until somebody in control was heard, `age` is infinite.
    """

    def __init__(self, stream: socket.socket, clock: Callable[[], int] = time.monotonic_ns) -> None:
        """`stream` is the line to the page; by `clock` [ns] it is known how long ago a person was heard."""
        self._stream: socket.socket | None = stream
        stream.setblocking(False)
        stream.setsockopt(socket.SOL_SOCKET, socket.SO_SNDBUF, ROOM)
        self._clock = clock
        self._snapshots = Snapshots()
        self._waiting: list[Event] = []
        self._untold: list[bytes] = []  # what must arrive, in its order
        self._panel: bytes | None = None  # the newest one, where it was not taken yet
        self._truth: Truth | None = None
        self._shows_truth = False
        self._intent = Intent()
        self._heard_ns: int | None = None
        self._wishes: dict[str, PageRequest] = {}  # the newest of each kind that `take` hands out
        self._actions: deque[PageRequest] = deque(maxlen=MOST_ACTIONS)

    @property
    def alive(self) -> bool:
        """Whether there is a page at the other end."""
        return self._stream is not None

    def fileno(self) -> int:
        """For `select`; -1 where there is no page any more."""
        return -1 if self._stream is None else self._stream.fileno()

    def begin(self, info: RunInfo, truth: Truth | None = None, start_ns: int | None = None) -> None:
        """Something runs from here on: its robot's truth, where it is simulated, may be shown. Its time counts from
        `start_ns` of the body's clock, by default from its first tick."""
        self._snapshots, self._truth = Snapshots(start_ns), truth
        self._tell("run", info)

    def end(self, outcome: str, text: str) -> None:
        """It has ended: how, in a word and in a sentence."""
        self._truth = None
        self._tell("end", (outcome, text))

    def show(self, panel: Panel | None) -> None:
        """Put a panel on the page, in the place of the one before; None: none."""
        values = None if panel is None else panel.plain()
        self._panel = pickle.dumps(("panel", values), pickle.HIGHEST_PROTOCOL)
        self._flush()

    def __call__(self, record: TickRecord) -> None:
        """Publish a tick."""
        if self._stream is None:
            return
        self._waiting += record.events
        truth = self._truth if self._shows_truth else None
        self.publish(self._snapshots.take(record, truth, tuple(self._waiting)))
        del self._waiting[:-KEPT]

    def publish(self, snapshot: Snapshot) -> None:
        """Publish a tick that was made elsewhere."""
        if self._flush() and self._send(pickle.dumps(("tick", snapshot), pickle.HIGHEST_PROTOCOL)):
            self._waiting.clear()

    def read(self) -> Intent:
        """What the person at the page wants now."""
        self._receive()
        age = math.inf if self._heard_ns is None else (self._clock() - self._heard_ns) * 1e-9
        return replace(self._intent, age=age)

    def take_halt(self) -> Halt:
        """A wish to stop, once, for whoever is no run, which ends with the first."""
        self._receive()
        halt = self._intent.halt
        self._intent = replace(self._intent, halt=Halt.NO)
        return halt

    def take(self, kind: str) -> PageRequest | None:
        """The newest wish of a kind of TAKEN, once. With one to start a task, what was asked before is forgotten, and
        from now on a wish to stop holds for the run to come."""
        self._receive()
        request = self._wishes.pop(kind, None)
        if request is not None and kind == "start":
            self._intent = Intent(request.sequence)
        return request

    def take_actions(self) -> list[PageRequest]:
        """What was asked for on the panel since the last look, in its order: requests of kind "do"."""
        self._receive()
        taken = list(self._actions)
        self._actions.clear()
        return taken

    def close(self) -> None:
        """Hang up: the page says that its program has ended, and ends."""
        if self._stream is not None:
            self._flush()
            self._hang_up()

    def _tell(self, kind: str, value: object) -> None:
        self._untold.append(pickle.dumps((kind, value), pickle.HIGHEST_PROTOCOL))
        self._flush()

    def _flush(self) -> bool:
        """Send what must arrive; whether all of it was taken."""
        while self._untold and self._send(self._untold[0]):
            del self._untold[0]
        if not self._untold and self._panel is not None and self._send(self._panel):
            self._panel = None
        return not self._untold and self._panel is None

    def _send(self, message: bytes) -> bool:
        """Whether the page's end of the line took a message; it may be full, or gone."""
        if self._stream is None:
            return False
        try:
            self._stream.send(message)
        except BlockingIOError:
            return False
        except OSError:  # the page is gone, or the message too long for any line: without a page the run goes on
            self._hang_up()
            return False
        return True

    def _receive(self) -> None:
        for _ in range(MOST):
            if self._stream is None:
                return
            try:
                data = self._stream.recv(LONGEST + 1)
            except BlockingIOError:
                return
            except OSError:
                data = b""
            if not data:
                self._hang_up()
                return
            with contextlib.suppress(ValueError):  # of a page that is not itself: nobody was heard
                self._heed(parse_request(data))

    def _heed(self, request: PageRequest) -> None:
        """Take a request up, unless it is older than the newest one: a wish to stop never is too old."""
        wish = self._intent
        if request.kind in HALTS:
            halt = Halt.AT_ONCE if request.kind == "off" else Halt.ORDERLY
            self._intent = replace(wish, halt=max(wish.halt, halt))
            return
        if request.sequence <= wish.sequence:
            return
        wish = replace(wish, sequence=request.sequence)
        if request.kind == "truth":
            self._shows_truth = request.on
        elif request.kind in TAKEN:
            self._wishes[request.kind] = request
        elif request.kind == "do":
            self._actions.append(request)
        elif request.kind not in OPEN:
            self._heard_ns = self._clock()
            wish = _after(wish, request)
        self._intent = wish

    def _hang_up(self) -> None:
        assert self._stream is not None
        self._stream.close()
        self._stream = None


def _after(wish: Intent, request: PageRequest) -> Intent:
    """What is wanted after a request of the person in control."""
    if request.kind == "beat":
        way = np.array(request.way)
        if way.any():  # sticks that are let go leave a goal standing
            return replace(wish, way=way, goal=None, text=None, skill=None)
        return replace(wish, way=way)
    still = replace(wish, way=np.zeros(3), goal=None, text=None, skill=None)
    if request.kind == "goal":
        return replace(still, goal=np.array(request.place))
    if request.kind == "text":
        return replace(still, text=request.text)
    if request.kind == "skill":
        return replace(still, skill=request.text, skills=wish.skills + 1)
    if request.kind == "rest":
        return still
    return replace(wish, ends=True) if request.kind == "end" else wish

"""A set of registers that is read from many servos tick after tick, and what each of them answered last.

    positions = GroupRead.of("present_position", {servo.id: servo.table for servo in servos})
    bus.sync_read(positions)
    positions.data[0]      # bytes of the first servo's newest answer; positions.fresh[0]: whether it came now

The rest of the class is for the bus: `request_all` and `request_missing` say what to send, `take` and `take_all` what
to believe of what comes, `close` and `queue_silent_last` what to remember of what did not.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence

from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.codec import FAST_BLOCK, FAST_HEAD, OVERHEAD, STUFFED, Status
from servoid.hw.dynamixel.protocol.tables import ControlTable

SHAPES = 8  # lengths that requests rotate through after a loss: more than are sent in the time an answer may be late
PATIENCE = 3  # reads in a row that a servo may miss before it is no longer asked twice in a tick


class Request:
    """One request on the wire: whom it asks, for what, and how its answer looks."""

    def __init__(self, parts: Sequence[tuple[int, int, int]], fast: bool, pad: int) -> None:
        """`parts` are (ID, address, length); each read begins `pad` bytes early."""
        padded = [(id, address - pad, length + pad) for id, address, length in parts]
        self.ids = [id for id, _, _ in parts]
        self.lengths = [length for _, _, length in padded]
        self.expected = dict(zip(self.ids, self.lengths, strict=True))
        self.pad = pad
        self.fast = fast and len(parts) > 1
        same = len({(address, length) for _, address, length in padded}) == 1
        if len(padded) == 1:
            self.packet = codec.read(*padded[0])
        elif same:
            self.packet = codec.sync_read(self.ids, padded[0][1], padded[0][2], fast=fast)
        else:
            self.packet = codec.bulk_read(padded, fast=fast)
        self.same = same  # all are asked for the same
        self.id_bytes = bytes(self.ids)
        self.heads = [codec.status_head(id, self.lengths[0]) for id in self.ids] if same else []
        self.head = codec.fast_head(self.lengths) if self.fast else b""
        if self.fast:
            self.answer = FAST_HEAD + FAST_BLOCK * len(padded) + sum(self.lengths)
        else:
            self.answer = OVERHEAD * len(padded) + sum(self.lengths)
        self._last = OVERHEAD + self.lengths[-1]  # bytes of the last status

    def looks_whole(self, stream: bytes) -> bool:
        """Whether an answer has come to its end, as far as a glance can tell: nothing more is on its way, though what
        came may be damaged."""
        if len(stream) != self.answer:
            return False
        if self.fast:
            return stream.startswith(self.head)
        if not self.same:
            return False
        return stream.startswith(self.heads[-1], -self._last) and STUFFED not in stream[-self._last :]


class GroupRead:
    """What to read, `parts` being (ID, address, length) of each servo, and the newest answers in that order.

    Two things keep answers from being taken for others. A servo that did not answer is asked last from then on, because
    each waits for the one before it. And after a loss the next request is for a few bytes more, so that an answer that
    comes late fits nothing that is expected by then.
    """

    def __init__(self, parts: Sequence[tuple[int, int, int]], *, fast: bool = False) -> None:
        """Raises ValueError for an ID that is asked twice."""
        n = len(parts)
        self.parts = tuple(parts)
        self.ids = tuple(id for id, _, _ in parts)
        self.fast = fast
        self.data: list[bytes | None] = [None] * n  # of the newest good answer
        self.time_ns: list[int | None] = [None] * n  # when that was sampled
        self.fresh = [False] * n  # answered at the newest read
        self.error = [0] * n  # StatusError of the newest answer
        self.alert = [False] * n  # its alert bit
        self.misses = [0] * n  # reads in a row without an answer
        self._index = {id: i for i, id in enumerate(self.ids)}
        self._order = list(range(n))
        self._shape = 0
        self._room = min((address for _, address, _ in parts), default=0)
        self._requests: dict[tuple[tuple[int, ...], bool, int], Request] = {}
        if len(self._index) != n:
            raise ValueError(f"an ID is asked twice: {sorted(self.ids)}")

    @classmethod
    def of(cls, register: str, tables: Mapping[int, ControlTable]) -> GroupRead:
        """A register of many servos: `tables` by ID. Raises KeyError where a model has no such register."""
        return cls([(id, table.item(register).address, table.item(register).width) for id, table in tables.items()])

    def request_all(self) -> Request:
        """The request of a new read, to all."""
        self.fresh = [False] * len(self.ids)
        return self._request(tuple(self._order), self.fast)

    def request_missing(self) -> Request | None:
        """A plain request to those that did not answer, or None if there is nobody worth asking again."""
        if not any(self.fresh) and all(self.misses):
            return None  # nobody there, again: it is the line
        lost = tuple(i for i in self._order if not self.fresh[i] and self.misses[i] <= PATIENCE)
        return self._request(lost, False) if lost else None

    def take(self, request: Request, status: Status, time_ns: int) -> bool:
        """Take an answer to `request`; False if it is none."""
        i = self._index.get(status.id)
        expected = request.expected.get(status.id)
        if i is None or expected is None or self.fresh[i]:
            return False
        if status.error:
            self.error[i], self.alert[i] = status.error, status.alert
            return True
        if len(status.data) != expected:
            return False
        self.data[i], self.time_ns[i], self.fresh[i] = status.data[request.pad :], time_ns, True
        self.error[i], self.alert[i], self.misses[i] = 0, status.alert, 0
        return True

    def take_all(self, request: Request, stream: bytes, time_ns: int) -> bool:
        """Take the answers of everybody at once, if `stream` is exactly that; the usual case, and the quickest."""
        if not request.same or len(request.ids) != len(self.ids):
            return False
        if request.fast:
            data = codec.whole_fast(stream, request.head, request.id_bytes, request.lengths[0])
        else:
            data = codec.whole_sync(stream, request.heads, request.lengths[0])
        if data is None:
            return False
        n, pad = len(data), request.pad
        if pad:
            data = [each[pad:] for each in data]
        for i, each in zip(self._order, data, strict=True):
            self.data[i] = each
        self.time_ns, self.fresh, self.misses = [time_ns] * n, [True] * n, [0] * n
        self.error, self.alert = [0] * n, [False] * n
        return True

    def doubt(self, id: int) -> None:
        """Two different answers came from `id`: neither is believed."""
        self.fresh[self._index[id]] = False

    def close(self, request: Request) -> list[int]:
        """Close a request; returns the IDs that it was lost on."""
        lost = [id for id in request.ids if not self.fresh[self._index[id]]]
        if lost:
            self._shape = (self._shape + 1) % SHAPES
        return lost

    def queue_silent_last(self) -> None:
        """Close a read: who did not answer goes to the end of the line."""
        if all(self.fresh):
            return
        for i, fresh in enumerate(self.fresh):
            self.misses[i] += not fresh
        self._order.sort(key=lambda i: (self.misses[i] > 0, i))

    def _request(self, order: tuple[int, ...], fast: bool) -> Request:
        pad = min(self._shape, self._room)
        key = (order, fast, pad)
        request = self._requests.get(key)
        if request is None:
            if len(self._requests) > 64:
                self._requests.clear()
            request = self._requests[key] = Request([self.parts[i] for i in order], fast, pad)
        return request

"""The half-duplex wire: who transmits when, what a collision does to bytes, and when the adapter hands them over.

A transmission takes ten bits a byte at its sender's baud. Where two overlap, the line shows the AND of both; a host
that transmits hears nothing.
"""

from __future__ import annotations

import heapq
import itertools
from dataclasses import dataclass, field

from servoid.hw.dynamixel.protocol.codec import FRAME_BITS

BATCH_NS = 500_000  # what the adapter waits for more bytes when a reply follows upon another
_GAP_NS = 100_000  # silence that ends such a burst
_BAUD_TOLERANCE = 0.03  # of a UART


@dataclass
class Transmission:
    """Bytes on the line. `lost` marks those that the host does not hear by themselves."""

    start_ns: int
    baud: int
    data: bytearray
    host: bool
    lost: set[int] = field(default_factory=set)

    @property
    def byte_ns(self) -> float:
        return FRAME_BITS * 1e9 / self.baud

    @property
    def end_ns(self) -> int:
        return self.start_ns + round(len(self.data) * self.byte_ns)

    def heard(self, host_baud: int) -> bytes:
        """What the host receives: at another baud, other bytes."""
        if same_baud(self.baud, host_baud):
            return bytes(b for i, b in enumerate(self.data) if i not in self.lost) if self.lost else bytes(self.data)
        count = max(1, round(len(self.data) * host_baud / self.baud)) if self.data else 0
        return bytes(self.data[i * len(self.data) // count] ^ 0x9C for i in range(count))


def same_baud(a: int, b: int) -> bool:
    """Whether UARTs at these bauds understand each other."""
    return a == b or abs(a - b) <= _BAUD_TOLERANCE * max(a, b)


class Wire:
    """Events of the line in order of time. Times are the rig's, in nanoseconds."""

    def __init__(self) -> None:
        self.host_baud = 57600
        self.collisions = 0
        self.adapter_ns = 0  # a batch that the adapter waits for: 16 ms where its latency timer was not set
        self._line: list[Transmission] = []  # under way or to come
        self._count = itertools.count()
        self._received: list[tuple[int, int, Transmission]] = []  # host transmissions by their end
        self._replies: list[tuple[int, int, Transmission]] = []  # device transmissions by their end
        self._host_free_ns = 0

    def clear(self) -> None:
        """Forget everything under way."""
        self._line.clear()
        self._received.clear()
        self._replies.clear()
        self._host_free_ns = 0

    @property
    def busy(self) -> bool:
        """Whether bytes of the host or answers to them are still under way."""
        return bool(self._received or self._replies)

    def host_sends(self, data: bytes, now_ns: int) -> None:
        """Bytes that the host's program wrote at `now_ns`; they queue behind those before."""
        sent = Transmission(max(now_ns, self._host_free_ns), self.host_baud, bytearray(data), True)
        self._host_free_ns = sent.end_ns
        self._transmit(sent, now_ns)
        heapq.heappush(self._received, (sent.end_ns, next(self._count), sent))

    def device_sends(self, data: bytes, start_ns: int, baud: int, now_ns: int) -> Transmission:
        """A reply that begins at `start_ns`, now or later."""
        sent = Transmission(start_ns, baud, bytearray(data), False)
        self._transmit(sent, now_ns)
        heapq.heappush(self._replies, (sent.end_ns, next(self._count), sent))
        return sent

    def _transmit(self, new: Transmission, now_ns: int) -> None:
        self._line = [old for old in self._line if old.end_ns > now_ns]
        for old in self._line:
            if old.start_ns < new.end_ns and new.start_ns < old.end_ns and not (old.host and new.host):
                self._collide(old, new)
        self._line.append(new)

    def _collide(self, old: Transmission, new: Transmission) -> None:
        self.collisions += 1
        device, other = (new, old) if old.host else (old, new)
        for i in range(len(new.data)):
            middle = new.start_ns + (i + 0.5) * new.byte_ns
            j = int((middle - old.start_ns) // old.byte_ns)
            if 0 <= j < len(old.data):
                old.data[j] = new.data[i] = old.data[j] & new.data[i]
                if other.host:
                    device.lost.add(j if device is old else i)
                else:
                    new.lost.add(i)  # the line carries one stream

    def next_instruction(self) -> int | None:
        """When the next bytes of the host will have arrived at the devices."""
        return self._received[0][0] if self._received else None

    def take_instruction(self) -> Transmission:
        """The host's oldest bytes."""
        return heapq.heappop(self._received)[2]

    def next_delivery(self) -> int | None:
        """When the adapter hands over what the devices sent: at the end of a burst, but soon after its beginning."""
        if not self._replies:
            return None
        first = self._replies[0][0]
        if self.adapter_ns:
            return -(-first // self.adapter_ns) * self.adapter_ns
        end = first
        for at, _, sent in sorted(self._replies):
            if sent.start_ns - end > _GAP_NS or at - first > BATCH_NS:
                break
            end = max(end, at)
        return end

    def take_delivery(self, now_ns: int) -> bytes:
        """What has arrived at the host by `now_ns`."""
        data = bytearray()
        while self._replies and self._replies[0][0] <= now_ns:
            data += heapq.heappop(self._replies)[2].heard(self.host_baud)
        return bytes(data)

"""The half-duplex bus: one write, one sleep until the answer must have ended, one read.

Every exchange has a deadline: the time on the wire, the servos' return delay, and a small margin. After anything went
wrong the line is drained to silence before the next packet, or that would collide with what is still to come. The bus
can be left at any moment by an exception (Ctrl-C): the next call finds the mark and cleans up.
"""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import NamedTuple

from servoid.hw.clock import WallClock
from servoid.hw.contracts.body import Clock
from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.codec import (
    FRAME_BITS,
    MAX_ID,
    OVERHEAD,
    Packet,
    PacketParser,
    Reset,
    Status,
    as_status,
    parse_fast,
)
from servoid.hw.dynamixel.protocol.tables import Item
from servoid.hw.dynamixel.transport.group_read import GroupRead, Request
from servoid.hw.dynamixel.transport.port import Port, SerialPort, drain

MARGIN = 0.0035  # s after the predicted end: a USB adapter's latency timer of 1 ms, and what may hold up host or servo
LONGEST_RETURN_DELAY = 254 * 2e-6  # s that a servo may be set to wait before it answers
GAP_NS = 2_000  # before an answer, at return delay 0
PING_DATA = 3  # bytes: model number, firmware
PING_GAP_NS = 3_000_000  # that a servo may take to its turn in a broadcast ping
EEPROM_SECONDS = 0.02  # that a servo may take to write its EEPROM before it answers
_POLL_NS = 100_000
_AIM_NS, _AIM_STEP_NS = 100_000, 2_000  # the most that is learned of late sleeps and late answers, and a step back
_LOOK_NS = 40_000  # in which an answer that is not there yet is looked for without sleeping
_QUIET_NS = 300_000  # of silence that end a drain: several bytes at any baud in use
_DRAIN_NS = 3_000_000  # that a drain may take within a tick
_SETTLE_NS = 25_000_000  # of silence after a lost single answer: above the latency of an untuned adapter


class Ping(NamedTuple):
    """What a servo says it is."""

    id: int
    model: int
    firmware: int
    alert: bool


@dataclass(slots=True)
class Counters:
    """What happened on the bus since it was opened."""

    exchanges: int = 0
    bytes_out: int = 0
    bytes_in: int = 0
    lost: int = 0  # answers that did not come, or not whole
    recovered: int = 0  # of these, how many a second request in the same tick brought
    refused: int = 0  # answers with an error
    bad_crc: int = 0
    garbage: int = 0  # bytes that belong to no packet
    stray: int = 0  # bytes that came when nothing was due: late answers, echoes, noise
    unexpected: int = 0  # packets that answer nothing that was asked
    duplicates: int = 0  # second answers of a servo that say the same
    conflicts: int = 0  # second answers that say something else: two servos with an ID
    drains: int = 0
    babble: int = 0  # drains that found no silence


class Bus:
    """Protocol 2.0 on a port. Methods raise BackendError when the port is gone; a servo that is silent is a None."""

    def __init__(self, port: Port, clock: Clock, *, margin: float = MARGIN) -> None:
        """`margin` [s] is what an answer may be later than predicted."""
        self.port, self.clock = port, clock
        self.counters = Counters()
        self.return_delay = 0.0  # s: the servos' setting
        self.margin = margin
        # In real time the line itself says when something comes; by a simulated clock it has to be asked.
        self._wakes = port if isinstance(port, SerialPort) and isinstance(clock, WallClock) else None
        self._parser = PacketParser()
        self._dirty = True  # something may still come that must not be taken for an answer
        self._busy_until = 0
        self._quiet_ns = _QUIET_NS
        self._aim_ns = 0  # from the predicted end of an answer to when to wake for it

    # The control cycle -----------------------------------------------------------------------------------------------

    def send(self, packet: bytes) -> None:
        """Send what nobody answers: a sync or bulk write, an action. Returns as soon as the adapter has it."""
        self._prepare()
        self._busy_until = self._write(packet)
        self._dirty = False

    def sync_read(self, *groups: GroupRead, before: bytes = b"", again: bool = True) -> int:
        """Read groups, one after the other. Answers that are lost are asked for once more at the end, by a plain read,
        unless `again` is False. `before` goes out ahead, in the same write: a packet that nobody answers. What came
        whole is looked into while the next answer is on its way. Returns how many did not answer."""
        later: Callable[[], None] | None = None
        for group in groups:
            later = self._exchange_group(group, group.request_all(), before, later)
            before = b""
        if later is not None:
            later()
        lost = 0
        for group in groups:
            came = sum(group.fresh)
            if came < len(group.ids) and again and (request := group.request_missing()) is not None:
                later = self._exchange_group(group, request)
                if later is not None:
                    later()
                self.counters.recovered += sum(group.fresh) - came
            group.queue_silent_last()
            lost += len(group.ids) - sum(group.fresh)
        return lost

    def _exchange_group(
        self,
        group: GroupRead,
        request: Request,
        before: bytes = b"",
        meanwhile: Callable[[], None] | None = None,
    ) -> Callable[[], None] | None:
        """One request. Returns what is left to do with an answer that came whole: the line is silent by then, and the
        next packet may go out first. `meanwhile` is what the exchange before this one returned."""
        if meanwhile is None:
            self._prepare()
        sampled = self._write(before + request.packet)
        if meanwhile is not None:
            meanwhile()
        gaps = 1 if request.fast else len(request.ids)
        predicted = sampled + self._wire_ns(request.answer, len(request.ids), gaps)
        stream = self._look(predicted)
        if request.looks_whole(stream):
            self.counters.bytes_in += len(stream)
            self._dirty = False
            return partial(self._take_whole, group, request, stream, sampled)
        self._take_pieces(group, request, stream, sampled, predicted)
        return None

    def _take_whole(self, group: GroupRead, request: Request, stream: bytes, sampled: int) -> None:
        if not group.take_all(request, stream, sampled):
            seen: dict[int, Status] = {}
            self._parser.reset()  # nothing of the exchange that goes on is in it yet
            for status in self._answers(request, stream):
                self._take(group, request, status, sampled, seen)
            self.counters.garbage += self._parser.pending
            self._parser.reset()
        self._close(group, request)

    def _take_pieces(self, group: GroupRead, request: Request, first: bytes, sampled: int, predicted: int) -> None:
        """An answer of which only `first` has come by its predicted end."""
        seen: dict[int, Status] = {}
        if request.fast:
            stream = bytearray()
            self._collect(predicted, lambda data: _fast_missing(stream, data, request), came=first)
            if not group.take_all(request, bytes(stream), sampled):
                for status in self._answers(request, bytes(stream)):
                    self._take(group, request, status, sampled, seen)
        else:

            def missing(data: bytes) -> int:
                if len(data) == request.answer and not seen and group.take_all(request, data, sampled):
                    return 0
                for status in self._answers(request, data):
                    self._take(group, request, status, sampled, seen)
                return (len(request.ids) - len(seen)) * request.answer // len(request.ids)

            self._collect(predicted, missing, came=first)
        self._dirty = self._close(group, request) > 0

    def _answers(self, request: Request, data: bytes) -> list[Status]:
        """The good answers in bytes of which not all are."""
        if not request.fast:
            return self._statuses(data)
        return [status for status in parse_fast(data, request.ids, request.lengths) if status is not None]

    def _close(self, group: GroupRead, request: Request) -> int:
        """Count on how many a request was lost."""
        lost = len(group.close(request))
        self.counters.lost += lost
        return lost

    def _take(self, group: GroupRead, request: Request, status: Status, sampled: int, seen: dict[int, Status]) -> None:
        if status.id in seen:
            if seen[status.id] == status:
                self.counters.duplicates += 1
            else:
                self.counters.conflicts += 1
                group.doubt(status.id)
        elif group.take(request, status, sampled):
            seen[status.id] = status
            self.counters.refused += status.error != 0
        else:
            self.counters.unexpected += 1

    # One servo at a time ---------------------------------------------------------------------------------------------

    def ping(self, id: int, tries: int = 2) -> Ping | None:
        status = self._ask(codec.ping(id), id, PING_DATA, tries)
        return _as_ping(status) if status and not status.error else None  # an error comes without the model

    def read(self, id: int, address: int, length: int, tries: int = 3) -> Status | None:
        """Read bytes. The status has an error and no data if the servo refused."""
        return self._ask(codec.read(id, address, length), id, length, tries)

    def write(self, id: int, address: int, data: bytes, tries: int = 3) -> Status | None:
        """Write bytes, waiting as long as EEPROM takes. Its status tells whether the servo refused."""
        return self._ask(codec.write(id, address, data), id, 0, tries, EEPROM_SECONDS)

    def read_item(self, id: int, item: Item, tries: int = 3) -> int | None:
        """Raw value of a register; None if the servo is silent or refused."""
        status = self.read(id, item.address, item.width, tries)
        return item.decode(status.data) if status and not status.error else None

    def write_item(self, id: int, item: Item, value: int, tries: int = 3) -> bool:
        """Whether the servo acknowledged. Raises ValueError if the value does not fit the register."""
        status = self.write(id, item.address, item.encode(value), tries)
        return status is not None and not status.error

    def reg_write(self, id: int, address: int, data: bytes) -> Status | None:
        """Write at the next `action`."""
        return self._ask(codec.reg_write(id, address, data), id, 0, 1)

    def action(self) -> None:
        """Let every registered write happen, at once."""
        self.send(codec.action())

    def reboot(self, id: int) -> Status | None:
        """Restart a servo: torque is off and RAM as after power-on, some 0.3 s later."""
        return self._ask(codec.reboot(id), id, 0, 1)

    def clear(self, id: int) -> Status | None:
        """Forget whole turns."""
        return self._ask(codec.clear(id), id, 0, 1)

    def factory_reset(self, id: int, spare: Reset) -> Status | None:
        return self._ask(codec.factory_reset(id, spare), id, 0, 1, EEPROM_SECONDS)

    def broadcast_ping(self) -> list[Ping]:
        """Everyone who answers, in the order that they did; an ID that answers twice is listed twice."""
        self._prepare()
        sent = self._write(codec.ping())
        byte = self._byte_ns()
        end = sent + (MAX_ID + 1) * (PING_GAP_NS + (OVERHEAD + PING_DATA) * byte)
        found: list[Ping] = []

        def missing(data: bytes) -> int:
            found.extend(_as_ping(s) for s in self._statuses(data) if len(s.data) == PING_DATA and not s.error)
            return 1  # as far as anyone knows

        self._collect(end, missing, first=sent, poll_ns=5_000_000)
        self._dirty = False
        return found

    def set_baud(self, baud: int) -> None:
        """Change the port's own speed."""
        self.clock.sleep_until(self._busy_until)
        self.port.set_baud(baud)
        self._dirty = True

    def _ask(self, packet: bytes, id: int, length: int, tries: int, patience: float = 0.0) -> Status | None:
        for _ in range(tries):
            self._prepare()
            sent = self._write(packet)
            answer: list[Status] = []

            def missing(data: bytes, answer: list[Status] = answer) -> int:
                for status in self._statuses(data):
                    if status.id == id and (status.error or len(status.data) == length):
                        answer.append(status)
                    else:
                        self.counters.unexpected += 1
                return 0 if answer else OVERHEAD + length

            predicted = sent + self._wire_ns(OVERHEAD + length, 1, 1)
            self._collect(predicted, missing, extra_ns=round(patience * 1e9))
            if answer:
                self._dirty = False
                self.counters.duplicates += len(answer) - 1
                self.counters.refused += answer[0].error != 0
                return answer[0]
            self.counters.lost += 1
            self._quiet_ns = _SETTLE_NS  # a late answer to this would look like one to the next
        return None

    # The line --------------------------------------------------------------------------------------------------------

    def _prepare(self) -> None:
        """Make sure that nothing is on its way, in either direction."""
        self.clock.sleep_until(self._busy_until)
        if self._dirty:
            quiet = self._quiet_ns
            dropped, silent = drain(self.port, self.clock, quiet, quiet + _DRAIN_NS)
            self.counters.drains += 1
            self.counters.babble += not silent
            self._dirty, self._quiet_ns = False, _QUIET_NS
        else:
            dropped = len(self.port.read())
        self.counters.stray += dropped
        self.counters.garbage += self._parser.pending
        self._parser.reset()

    def _write(self, packet: bytes) -> int:
        """Write; returns when the last byte leaves. Until its answer was seen, the line counts as dirty."""
        self._dirty = True
        self.port.write(packet)
        end = self.clock.now_ns() + len(packet) * self._byte_ns()
        self.counters.exchanges += 1
        self.counters.bytes_out += len(packet)
        return end

    def _look(self, predicted: int) -> bytes:
        """What has come by the predicted end of an answer. Sleeps end late, and so do answers: when to wake is learned
        from both, so that half of the answers are there at the first look and the others microseconds later."""
        clock, port = self.clock, self.port
        if self._wakes is None:
            clock.sleep_until(predicted)
            return port.read()
        wanted = predicted + self._aim_ns
        clock.sleep_until(wanted)
        if data := port.read():
            self._aim_ns = max(self._aim_ns - _AIM_STEP_NS, -_AIM_NS)
            return data
        looked = now = clock.now_ns()
        while not data and now < looked + _LOOK_NS:
            data, now = port.read(), clock.now_ns()
        self._aim_ns = min(self._aim_ns + (now - looked) // 4, _AIM_NS)
        return data

    def _collect(
        self,
        predicted: int,
        missing: Callable[[bytes], int],
        *,
        extra_ns: int = 0,
        first: int | None = None,
        poll_ns: int = _POLL_NS,
        came: bytes | None = None,
    ) -> None:
        """Feed what comes to `missing`, which returns how many bytes are, until there are none or the deadline is over.
        The first look is when the answer must have ended, unless `came` is what it gave; whatever came before we look
        is on time, however late."""
        deadline = predicted + round(self.margin * 1e9) + extra_ns
        if came is None:
            self.clock.sleep_until(predicted if first is None else first)
            came = self.port.read()
        data = came
        while True:
            self.counters.bytes_in += len(data)
            left = missing(data) if data else 0
            if data and not left:
                return
            now = self.clock.now_ns()
            if now >= deadline:
                return
            if self._wakes is not None and not data:
                self._wakes.wait((deadline - now) * 1e-9)
            else:
                self.clock.sleep_until(min(now + max(poll_ns, left * self._byte_ns()), deadline))
            data = self.port.read()

    def _statuses(self, data: bytes) -> list[Status]:
        parser, counters = self._parser, self.counters
        garbage, bad = parser.garbage, parser.bad_crc
        packets: list[Packet] = parser.feed(data)
        counters.garbage += parser.garbage - garbage
        counters.bad_crc += parser.bad_crc - bad
        return [status for packet in packets if (status := as_status(packet)) is not None]

    def _byte_ns(self) -> int:
        return round(FRAME_BITS * 1e9 / self.port.baud)

    def _wire_ns(self, size: int, answers: int, gaps: int) -> int:
        """How long so many bytes of so many answers take; a fast frame has one gap for all."""
        return size * self._byte_ns() + round(answers * self.return_delay * 1e9) + gaps * GAP_NS


def _as_ping(status: Status) -> Ping:
    data = status.data
    return Ping(status.id, data[0] | data[1] << 8, data[2], status.alert)


def _fast_missing(stream: bytearray, data: bytes, request: Request) -> int:
    """Add `data` to what came of a fast frame; how many bytes are missing."""
    stream += data
    if len(stream) < request.answer:
        return request.answer - len(stream)
    start = stream.find(request.head)
    return request.answer if start < 0 else max(0, start + request.answer - len(stream))

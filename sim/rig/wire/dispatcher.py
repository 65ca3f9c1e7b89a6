"""Instructions from the wire to the devices, and their replies onto it, each in its turn.

A device whose protocol type says so hears protocol 1.0 alone, and is not there for those who speak 2.0.
"""

from __future__ import annotations

import functools
import operator
import struct
from collections.abc import Iterable, Iterator, Sequence

from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.codec import (
    FRAME_BITS,
    HEADER,
    InstructionCode,
    Packet,
    PacketParser,
    Status,
    StatusError,
)
from servoid.hw.dynamixel.protocol.crc import crc16
from servoid.sim.rig.servo.device import VirtualDevice
from servoid.sim.rig.wire import protocol1
from servoid.sim.rig.wire.faults import MISSPOKEN, STATUS_KINDS, Chunk, FaultInjector
from servoid.sim.rig.wire.half_duplex import Wire, same_baud

TURNAROUND_NS = 2_000  # from the last byte of a request to the first of the reply, at return delay 0
_SILENCE_NS = 1_500_000  # a packet that stops for so long is given up
_LONGEST_CHAIN_NS = 500_000_000  # after which the rest of a group has given up
_LONGEST_FRAME = 4096  # bytes that a servo can count in a fast read
_STATUS_BYTES = 11  # of a status without data
_PING_BYTES = 14  # of the answer to a ping

Part = tuple[int, int, int]  # ID, address, length of a read


class Dispatcher:
    """Devices on a wire. Devices at another baud than the host's neither hear it nor count."""

    def __init__(self, wire: Wire, injector: FaultInjector) -> None:
        self.wire, self.injector = wire, injector
        self.devices: list[VirtualDevice] = []
        self.instructions = 0
        self._parser, self._old_parser = PacketParser(), protocol1.Protocol1Parser()
        self._heard_ns = 0

    def receive(self, data: bytes, baud: int, now_ns: int) -> None:
        """Bytes of the host whose last arrived at `now_ns`."""
        if now_ns - _wire_ns(len(data), baud) - self._heard_ns > _SILENCE_NS:
            self._parser.reset()
            self._old_parser.reset()
        self._heard_ns = now_ns
        spoiled = self._parser.bad_crc
        packets = self._parser.feed(data)
        for packet in packets:
            if packet.instruction != InstructionCode.STATUS:
                self._dispatch(packet, self._listening(baud, now_ns), now_ns)
        if not packets and self._parser.bad_crc > spoiled:
            self._refuse(data, self._listening(baud, now_ns), now_ns)
        if any(device.old_protocol for device in self.devices):
            for packet in self._old_parser.feed(data):
                self._dispatch_old(packet, self._listening(baud, now_ns, old=True), now_ns)

    def _listening(self, baud: int, now_ns: int, *, old: bool = False) -> list[VirtualDevice]:
        return [
            device
            for device in self.devices
            if device.online(now_ns) and same_baud(device.baud, baud) and device.old_protocol is old
        ]

    def _refuse(self, data: bytes, listening: list[VirtualDevice], now_ns: int) -> None:
        """A packet whose checksum is wrong, by itself on the line: the one that it names says so."""
        if data.startswith(HEADER) and len(data) >= 7 and len(data) == 7 + int.from_bytes(data[5:7], "little"):
            for device in _called(listening, data[4]):
                if device.talkative:
                    self._send(device.status(StatusError.CRC), now_ns + _pause(device), device.baud, now_ns)

    def _dispatch(self, packet: Packet, listening: list[VirtualDevice], now_ns: int) -> None:
        self.instructions += 1
        for device in listening:
            device.heard(now_ns)
        instruction, params = packet.instruction, packet.params
        if instruction in (InstructionCode.SYNC_READ, InstructionCode.FAST_SYNC_READ):
            if len(params) > 4:
                address, length = struct.unpack_from("<HH", params)
                parts = [(id, address, length) for id in params[4:]]
                self._read_group(parts, listening, instruction == InstructionCode.FAST_SYNC_READ, now_ns)
        elif instruction in (InstructionCode.BULK_READ, InstructionCode.FAST_BULK_READ):
            parts = list(struct.iter_unpack("<BHH", params[: len(params) // 5 * 5]))
            self._read_group(parts, listening, instruction == InstructionCode.FAST_BULK_READ, now_ns)
        elif instruction in (InstructionCode.SYNC_WRITE, InstructionCode.BULK_WRITE):
            writes = _sync_writes(params) if instruction == InstructionCode.SYNC_WRITE else _bulk_writes(params)
            _write_all(writes, listening, now_ns)
        elif packet.id == codec.BROADCAST:
            self._broadcast(packet, listening, now_ns)
        else:
            for device in listening:
                if device.shadow(packet.id):
                    device.execute_as_shadow(instruction, params, now_ns)
            for device in _called(listening, packet.id):
                baud, pause = device.baud, _pause(device)  # a change of either begins after the reply
                status = device.execute(instruction, params, now_ns)
                if status is not None:
                    self._send(status, now_ns + pause, baud, now_ns)

    def _dispatch_old(self, packet: Packet, listening: list[VirtualDevice], now_ns: int) -> None:
        """A packet of protocol 1.0."""
        self.instructions += 1
        for device in listening:
            device.heard(now_ns)
        if packet.instruction == InstructionCode.SYNC_WRITE:
            _write_all(_sync_writes(packet.params), listening, now_ns)
            return
        for device in listening:
            if packet.id != codec.BROADCAST and not device.answers_to(packet.id):
                continue
            baud, pause, hardware = device.baud, _pause(device), device.get("hardware_error_status")
            status = device.execute(packet.instruction, packet.params, now_ns, to=packet.id)
            if status is not None and packet.id != codec.BROADCAST:
                data = b"" if packet.instruction == InstructionCode.PING else status.data
                frame = protocol1.status(status.id, StatusError(status.error), hardware, data)
                self._put([Chunk(frame)], now_ns + pause, baud, now_ns)

    def _broadcast(self, packet: Packet, listening: list[VirtualDevice], now_ns: int) -> None:
        """To everyone: only a ping is answered, in the order of the IDs, by each in the slot of its own, or when those
        before it, who may wait longer by their return delay, have ended."""
        free_ns, last = now_ns, -1
        for device in sorted(listening, key=lambda device: device.id):
            baud, pause, id = device.baud, _pause(device), device.id
            status = device.execute(packet.instruction, packet.params, now_ns, to=codec.BROADCAST)
            if status is not None and packet.instruction == InstructionCode.PING:
                start = now_ns + pause + id * (_wire_ns(_PING_BYTES, baud) + TURNAROUND_NS)
                if id != last:  # two with one ID talk at once
                    start, last = max(start, free_ns + TURNAROUND_NS), id
                free_ns = max(free_ns, self._send(status, start, baud, now_ns))

    def _read_group(self, parts: Sequence[Part], listening: list[VirtualDevice], fast: bool, now_ns: int) -> None:
        """Sync and bulk reads. All sample now; each transmits when the one before it has."""
        if fast:
            if parts:
                self._read_fast(parts, listening, now_ns)
            return
        end = now_ns
        for id, address, length in parts:
            devices = _called(listening, id)
            answered = end
            for device in devices:
                start = end + _pause(device)
                status = device.sample(address, length, now_ns)
                if status is not None:
                    answered = max(answered, self._send(status, start, device.baud, now_ns))
            if answered == end:  # those after a silent one wait for as long as its reply would have taken
                answered += TURNAROUND_NS + _wire_ns(_STATUS_BYTES + length, self.wire.host_baud)
            end = answered
            if end - now_ns > _LONGEST_CHAIN_NS:
                return

    def _read_fast(self, parts: Sequence[Part], listening: list[VirtualDevice], now_ns: int) -> None:
        """One frame to which each adds its block. Whoever does not hear its predecessor stays silent."""
        lengths = [length for _, _, length in parts]
        if sum(lengths) > _LONGEST_FRAME:
            return
        able = [device for device in listening if device.fast()]
        first = next((device for device in able if device.answers_to(parts[0][0])), None)
        if first is None:
            return
        chunks: list[Chunk] = []
        head = codec.fast_head(lengths)
        crc = crc16(head)
        for id, address, length in parts:
            sampled = [device.sample(address, length, now_ns) for device in _called(able, id)]
            answers = [status for status in sampled if status is not None and len(status.data) == length]
            if not answers:
                break
            fault = self.injector.strikes(STATUS_KINDS, id, now_ns)
            if fault is not None:
                answers = [self.injector.misspeak(fault, status) for status in answers]
            block = _together([_block(status, crc, length) for status in answers])
            crc = crc16(block, crc)
            block, head = head + block, b""
            if self.injector.strikes(("garbage",), id, now_ns) is not None:
                chunks.append(Chunk(self.injector.noise(9)))
            if fault is None or fault.kind in MISSPOKEN:
                chunks.append(Chunk(block))
                continue
            chunks += self.injector.spoil(fault, block)
            if fault.kind in ("drop", "truncate"):
                break
        self._put(chunks, now_ns + _pause(first), first.baud, now_ns)

    def _send(self, status: Status, start_ns: int, baud: int, now_ns: int) -> int:
        """Put a status on the wire; returns when it ends."""
        frame = _frame(status)
        fault = self.injector.strikes(STATUS_KINDS, status.id, now_ns)
        if fault is not None and fault.kind in MISSPOKEN:
            chunks = [Chunk(_frame(self.injector.misspeak(fault, status)))]
        else:
            chunks = [Chunk(frame)] if fault is None else self.injector.spoil(fault, frame)
        if self.injector.strikes(("garbage",), status.id, now_ns) is not None:
            chunks.insert(0, Chunk(self.injector.noise(9)))
        return self._put(chunks, start_ns, baud, now_ns)

    def _put(self, chunks: list[Chunk], start_ns: int, baud: int, now_ns: int) -> int:
        """Chunks without a pause between them go out as one."""
        at, joined = start_ns, bytearray()
        for chunk in chunks:
            if chunk.wait:
                if joined:
                    at = self.wire.device_sends(bytes(joined), at, baud, now_ns).end_ns
                at, joined = at + round(chunk.wait * 1e9), bytearray()
            joined += chunk.data
        return self.wire.device_sends(bytes(joined), at, baud, now_ns).end_ns if joined else at


def _pause(device: VirtualDevice) -> int:
    """From the last byte of a request to the first of the device's reply [ns]."""
    return TURNAROUND_NS + device.return_delay_ns


def _write_all(writes: Iterable[tuple[int, int, bytes]], listening: list[VirtualDevice], now_ns: int) -> None:
    """Sync and bulk writes: nobody answers."""
    for id, address, data in writes:
        for device in listening:
            if device.answers_to(id):
                device.write(address, data, now_ns)
            elif device.shadow(id):
                device.write_as_shadow(address, data, now_ns)


def _called(devices: list[VirtualDevice], id: int) -> list[VirtualDevice]:
    return [device for device in devices if device.answers_to(id)]


def _frame(status: Status) -> bytes:
    return codec.status(status.id, _error(status), status.data)


def _block(status: Status, crc: int, length: int) -> bytes:
    """What a servo adds to a fast frame whose bytes so far have checksum `crc`, of which each has its place."""
    body = bytes([_error(status), status.id]) + status.data.ljust(length, b"\0")
    return body + crc16(body, crc).to_bytes(2, "little")


def _together(blocks: list[bytes]) -> bytes:
    """What the line carries when several servos speak at once: the AND of their bytes."""
    return bytes(functools.reduce(operator.and_, column) for column in zip(*blocks, strict=True))


def _error(status: Status) -> int:
    return int(status.error) | (codec.ALERT if status.alert else 0)


def _wire_ns(count: int, baud: int) -> int:
    return round(count * FRAME_BITS * 1e9 / baud)


def _sync_writes(params: bytes) -> Iterator[tuple[int, int, bytes]]:
    if len(params) >= 4:
        address, length = struct.unpack_from("<HH", params)
        for at in range(4, len(params) - length, length + 1):
            yield params[at], address, params[at + 1 : at + 1 + length]


def _bulk_writes(params: bytes) -> Iterator[tuple[int, int, bytes]]:
    at = 0
    while at + 5 <= len(params):
        id, address, length = struct.unpack_from("<BHH", params, at)
        data = params[at + 5 : at + 5 + length]
        if len(data) == length:
            yield id, address, data
        at += 5 + length

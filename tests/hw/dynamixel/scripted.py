"""A scripted bus: servos that are a memory, on a port whose time only sleeping advances, with faults to order."""

from __future__ import annotations

from collections.abc import Callable

from servoid.hw.contracts.body import BackendError
from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.codec import BROADCAST, InstructionCode, Packet, PacketParser
from servoid.hw.dynamixel.protocol.tables import ControlTable, table

BYTE_NS = 5000  # at 2 Mbit/s

# What a fault makes of an answer: (servo, bytes, delay ns) to a list of (bytes, delay ns).
Fault = Callable[[int, bytes], list[tuple[bytes, int]]]


class Memory:
    """A servo: its registers, and the few rules that a driver meets."""

    def __init__(self, model: str, id: int) -> None:
        self.table: ControlTable = table(model)
        self.bytes = bytearray(700)
        self.answers = True
        self.quiet = False  # firmware that does not raise the alert bit
        for item in self.table.items.values():
            if item.default is not None:
                self.put(item.name, item.default)
        self.put("id", id)
        self.put("firmware_version", 48)
        self.writes: list[tuple[str, int]] = []

    def get(self, name: str) -> int:
        item = self.table.item(name)
        return item.decode(self.bytes[item.address : item.end])

    def put(self, name: str, value: int) -> None:
        item = self.table.item(name)
        self.bytes[item.address : item.end] = item.encode(value)

    @property
    def alert(self) -> int:
        if self.quiet:
            return 0
        return codec.ALERT if "hardware_error_status" in self.table and self.get("hardware_error_status") else 0

    def write(self, address: int, data: bytes) -> int:
        at = address
        while at < address + len(data):
            item = self.table.at(at)
            if item is None or not item.writable:
                return codec.StatusError.ACCESS
            value = item.decode(data[at - address : at - address + item.width])
            if item.eeprom and "torque_enable" in self.table and self.get("torque_enable"):
                return codec.StatusError.ACCESS
            if item.range is not None and not item.range[0] <= value <= item.range[1]:
                return codec.StatusError.DATA_RANGE
            if item.name == "goal_position" and self.get("bus_watchdog") == 255:
                return codec.StatusError.DATA_RANGE
            self.writes.append((item.name, value))
            if not (item.name == "torque_enable" and value and self.get("hardware_error_status")):
                self.put(item.name, value)
            at = item.end
        return 0

    def reboot(self) -> None:
        for item in self.table.items.values():
            if not item.eeprom and not item.name.startswith("present"):
                self.put(item.name, item.default or 0)


class ScriptedBus:
    """A Port and a Clock in one."""

    name = "scripted"

    def __init__(self, servos: list[Memory]) -> None:
        self.servos = {servo.get("id"): servo for servo in servos}
        self.baud = 2_000_000
        self.time = 10**9
        self.fault: Fault | None = None
        self.before_answer: Callable[[Packet], None] | None = None
        self.sent: list[Packet] = []
        self.gone = False
        self.echo = False
        self._due: list[tuple[int, bytes]] = []
        self._parser = PacketParser()
        self.collisions = 0
        self._quiet_at = 0  # when the last answer on its way ends

    # Clock

    def now_ns(self) -> int:
        return self.time

    def sleep_until(self, time_ns: int) -> None:
        self.time = max(self.time, time_ns)

    # Port

    def set_baud(self, baud: int) -> None:
        self.baud = baud

    def close(self) -> None:
        self.gone = True

    def read(self) -> bytes:
        if self.gone:
            raise BackendError("scripted: the port is gone")
        now = [data for time, data in self._due if time <= self.time]
        self._due = [(time, data) for time, data in self._due if time > self.time]
        return b"".join(now)

    def write(self, data: bytes) -> None:
        if self.gone:
            raise BackendError("scripted: the port is gone")
        self.collisions += self.time < self._quiet_at
        end = self.time + len(data) * BYTE_NS
        if self.echo:
            self._put(data, self.time)
        for packet in self._parser.feed(data):
            self.sent.append(packet)
            if self.before_answer:
                self.before_answer(packet)
            self._answer(packet, end)

    def babble(self, data: bytes, delay_ns: int = 0) -> None:
        self._put(data, self.time + delay_ns)

    def _put(self, data: bytes, start: int) -> None:
        """Bytes come in as they would: each when it has passed."""
        for i, byte in enumerate(data):
            self._due.append((start + (i + 1) * BYTE_NS, bytes([byte])))
        self._due.sort(key=lambda item: item[0])

    def _emit(self, id: int, data: bytes, at: int) -> int:
        pieces = [(data, 0)] if self.fault is None else self.fault(id, data)
        for piece, delay in pieces:
            self._put(piece, at + delay)
            self._quiet_at = max(self._quiet_at, at + delay + len(piece) * BYTE_NS)
        return at + len(data) * BYTE_NS

    def _answer(self, packet: Packet, at: int) -> None:
        p = packet.params
        word = int.from_bytes(p[:2], "little")
        if packet.instruction in (InstructionCode.SYNC_READ, InstructionCode.FAST_SYNC_READ):
            parts = [(id, word, int.from_bytes(p[2:4], "little")) for id in p[4:]]
            self._group(packet.instruction == InstructionCode.FAST_SYNC_READ, parts, at)
        elif packet.instruction in (InstructionCode.BULK_READ, InstructionCode.FAST_BULK_READ):
            parts = [
                (p[i], int.from_bytes(p[i + 1 : i + 3], "little"), int.from_bytes(p[i + 3 : i + 5], "little"))
                for i in range(0, len(p), 5)
            ]
            self._group(packet.instruction == InstructionCode.FAST_BULK_READ, parts, at)
        elif packet.instruction == InstructionCode.SYNC_WRITE:
            width = int.from_bytes(p[2:4], "little")
            for i in range(4, len(p), 1 + width):
                if (servo := self.servos.get(p[i])) and servo.answers:
                    servo.write(word, p[i + 1 : i + 1 + width])
        elif packet.id == BROADCAST and packet.instruction == InstructionCode.PING:
            for servo in self.servos.values():
                at = self._emit(servo.get("id"), self._single(servo, packet), at + 1_000_000)
        elif (servo := self.servos.get(packet.id)) and servo.answers:
            self._emit(packet.id, self._single(servo, packet), at)

    def _single(self, servo: Memory, packet: Packet) -> bytes:
        p, error, data = packet.params, 0, b""
        word = int.from_bytes(p[:2], "little")
        if packet.instruction == InstructionCode.PING:
            data = servo.bytes[0:2] + servo.bytes[6:7]
        elif packet.instruction == InstructionCode.READ:
            data = bytes(servo.bytes[word : word + int.from_bytes(p[2:4], "little")])
        elif packet.instruction == InstructionCode.WRITE:
            error = servo.write(word, p[2:])
        elif packet.instruction == InstructionCode.REBOOT:
            servo.reboot()
        return codec.status(servo.get("id"), error | servo.alert, bytes(data))

    def _group(self, fast: bool, parts: list[tuple[int, int, int]], at: int) -> None:
        if not fast:
            for id, address, length in parts:
                servo = self.servos.get(id)
                if servo is None or not servo.answers:
                    continue
                data = bytes(servo.bytes[address : address + length])
                at = self._emit(id, codec.status(id, servo.alert, data), at)
            return
        blocks = []
        for id, address, length in parts:
            servo = self.servos.get(id)
            blocks.append(
                (id, servo.alert if servo else 0, bytes(servo.bytes[address : address + length]) if servo else b"")
            )
        silent = next(
            (i for i, (id, _, _) in enumerate(blocks) if id not in self.servos or not self.servos[id].answers), None
        )
        lengths = [length for _, _, length in parts]
        frame = codec.fast_status([(i, e, d or bytes(n)) for (i, e, d), n in zip(blocks, lengths, strict=True)])
        if silent is not None:  # whoever comes after a silent one waits for ever
            frame = frame[: 0 if silent == 0 else codec.FAST_HEAD + sum(codec.FAST_BLOCK + n for n in lengths[:silent])]
        self._emit(BROADCAST, frame, at)

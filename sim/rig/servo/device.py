"""A device on a Dynamixel bus as its firmware answers: a control table in memory, and instructions that touch it."""

from __future__ import annotations

import struct
from collections.abc import Callable, Iterator

from servoid.hw.dynamixel.codec import CLEAR_REVOLUTIONS, Instruction, Reset, Status, StatusError
from servoid.hw.dynamixel.tables import ControlTable, Item

_KEPT = {Reset.ALL: (), Reset.EXCEPT_ID: ("id",), Reset.EXCEPT_ID_AND_BAUD: ("id", "baud_rate")}


class VirtualDevice:
    """Registers and instructions common to servos and boards. Times are the rig's, in nanoseconds."""

    BOOT_NS = 300_000_000

    def __init__(self, table: ControlTable, eeprom: dict[str, int]) -> None:
        """`eeprom` holds what differs from the factory's values. Raises KeyError for a register that is not there."""
        self.table = table
        self.memory = bytearray(table.size)
        self._places = {name: (item.address, item.end, item.signed) for name, item in table.items.items()}
        self._starts = {item.address: item for item in table.items.values()}
        self._pointers = {block.data + i: block.address + 2 * i for block in table.indirect for i in range(block.count)}
        self._first_pointer = min(self._pointers, default=len(self.memory))
        self._registered: tuple[int, bytes] | None = None
        self.powered = True
        self.dead = False
        self._silent_until = 0
        self._load(lambda item: True)
        for name, value in eeprom.items():
            self.put(name, value)

    # Registers

    def get(self, name: str) -> int:
        """Raw value of a register. Raises KeyError where the model has none of that name."""
        start, end, signed = self._places[name]
        return int.from_bytes(self.memory[start:end], "little", signed=signed)

    def put(self, name: str, value: int) -> None:
        """Set a register from inside: no rule applies, and a value that does not fit is cut to what does."""
        item = self.table.item(name)
        bits = 8 * item.width
        low, high = (-(1 << (bits - 1)), (1 << (bits - 1)) - 1) if item.signed else (0, (1 << bits) - 1)
        self.memory[item.address : item.end] = item.encode(min(max(value, low), high))

    @property
    def id(self) -> int:
        return self.memory[7]  # as in every model, like the two below

    @property
    def baud(self) -> int:
        """Bits per second that the device listens at."""
        return self.table.bauds[min(self.memory[8], len(self.table.bauds) - 1)]

    @property
    def return_delay_ns(self) -> int:
        return self.memory[9] * 2000

    def answers_to(self, id: int) -> bool:
        return id == self.memory[7]

    def shadow(self, id: int) -> bool:
        """Whether the device obeys this ID too, without answering."""
        return "secondary_id" in self.table and id == self.get("secondary_id") and id != self.id

    def fast(self) -> bool:
        """Whether the firmware knows the fast reads."""
        oldest = self.table.fast_firmware
        return oldest is not None and self.get("firmware_version") >= oldest

    def online(self, now_ns: int) -> bool:
        """Whether the device has power, lives and has booted."""
        return self.powered and not self.dead and now_ns >= self._silent_until

    def _load(self, which: Callable[[Item], bool]) -> None:
        for item in self.table.items.values():
            if which(item):
                self.memory[item.address : item.end] = item.encode(item.default or 0)

    # What a kind of device adds

    def refresh(self, now_ns: int) -> None:
        """Bring the registers that measure something up to date."""

    def allowed(self, item: Item, value: int) -> StatusError:
        """Whether a write of `value` is accepted in the present state."""
        return StatusError.NONE

    def changed(self, item: Item, value: int, now_ns: int) -> None:
        """A write to `item` was accepted and is in memory."""

    def alert(self) -> bool:
        return False

    def clear(self, now_ns: int) -> StatusError:
        return StatusError.INSTRUCTION

    def heard(self, now_ns: int) -> None:
        """An intact instruction packet went by, for whomever."""

    def restarted(self, now_ns: int) -> None:
        """RAM was just lost."""

    # Instructions

    def execute(self, instruction: int, params: bytes, now_ns: int) -> Status | None:
        """Execute an instruction addressed to this device alone; the reply, if the status level wants one."""
        level = self.get("status_return_level") if "status_return_level" in self.table else 2
        error, data = self._execute(instruction, params, now_ns)
        if instruction == Instruction.PING:
            wanted = 0
        elif instruction == Instruction.READ:
            wanted = 1
        else:
            wanted = 2
        return self.status(error, data) if level >= wanted else None

    def sample(self, address: int, length: int, now_ns: int) -> Status | None:
        """The answer to a read within a group, if the status level wants one."""
        if "status_return_level" in self._places and not self.get("status_return_level"):
            return None
        return self.status(*self.read(address, length, now_ns))

    def status(self, error: int, data: bytes = b"") -> Status:
        return Status(self.id, int(error), self.alert(), data)

    def _execute(self, instruction: int, params: bytes, now_ns: int) -> tuple[StatusError, bytes]:
        word = int.from_bytes(params[:2], "little")
        if instruction == Instruction.PING:
            return StatusError.NONE, struct.pack("<HB", self.get("model_number"), self.get("firmware_version"))
        if instruction == Instruction.READ:
            if len(params) != 4:
                return StatusError.DATA_LENGTH, b""
            return self.read(word, int.from_bytes(params[2:4], "little"), now_ns)
        if instruction in (Instruction.WRITE, Instruction.REG_WRITE):
            if len(params) < 3:
                return StatusError.DATA_LENGTH, b""
            if instruction == Instruction.WRITE:
                return self.write(word, params[2:], now_ns), b""
            error = self._check(self._resolve(word, params[2:]))
            if error is StatusError.NONE:
                self._registered = word, params[2:]
                self._mark_registered()
            return error, b""
        if instruction == Instruction.ACTION:
            return self._action(now_ns), b""
        if instruction == Instruction.REBOOT:
            self.reboot(now_ns)
            return StatusError.NONE, b""
        if instruction == Instruction.FACTORY_RESET:
            return self._factory_reset(params, now_ns), b""
        if instruction == Instruction.CLEAR:
            if params != CLEAR_REVOLUTIONS:
                return StatusError.DATA_RANGE, b""
            return self.clear(now_ns), b""
        return StatusError.INSTRUCTION, b""

    def read(self, address: int, length: int, now_ns: int) -> tuple[StatusError, bytes]:
        """Bytes of the table, through indirect addresses where there are; gaps read zero."""
        if length == 0 or address + length > len(self.memory):
            return StatusError.DATA_RANGE, b""
        self.refresh(now_ns)
        data = bytearray(self.memory[address : address + length])
        if address + length > self._first_pointer:
            for at in range(max(address, self._first_pointer), address + length):
                pointer = self._pointers.get(at)
                if pointer is not None:
                    data[at - address] = self.memory[self._target(pointer, at)]
        return StatusError.NONE, bytes(data)

    def write(self, address: int, data: bytes, now_ns: int) -> StatusError:
        """Write registers, all or none."""
        writes = self._resolve(address, data)
        error = self._check(writes)
        if error is StatusError.NONE:
            self._apply(writes, now_ns)
        return error

    def _target(self, pointer: int, data: int) -> int:
        """Where an indirect data byte leads; one that points outside the table leads to itself."""
        target = int.from_bytes(self.memory[pointer : pointer + 2], "little")
        return target if target < len(self.memory) else data

    def _resolve(self, address: int, data: bytes) -> list[tuple[Item, int]] | StatusError:
        """The registers that `data` at `address` sets and their new values, or why not."""
        if address + len(data) > len(self.memory):
            return StatusError.DATA_RANGE
        runs: list[tuple[int, bytearray]] = []
        for offset, byte in enumerate(data):
            at = address + offset
            if at in self._pointers:
                at = self._target(self._pointers[at], at)
            if runs and at == runs[-1][0] + len(runs[-1][1]):
                runs[-1][1].append(byte)
            else:
                runs.append((at, bytearray([byte])))
        writes: list[tuple[Item, int]] = []
        for start, run in runs:
            for item, raw in self._split(start, bytes(run)):
                if item is None:
                    return StatusError.ACCESS
                if len(raw) < item.width:
                    return StatusError.DATA_LENGTH
                writes.append((item, item.decode(raw)))
        return writes

    def _split(self, start: int, run: bytes) -> Iterator[tuple[Item | None, bytes]]:
        at = 0
        while at < len(run):
            item = self._starts.get(start + at)
            yield item, run[at : at + (item.width if item else 1)]
            at += item.width if item else 1

    def _check(self, writes: list[tuple[Item, int]] | StatusError) -> StatusError:
        if isinstance(writes, StatusError):
            return writes
        for item, value in writes:
            if not item.writable:
                return StatusError.ACCESS
            error = self.allowed(item, value)
            if error is not StatusError.NONE:
                return error
        return StatusError.NONE

    def in_range(self, item: Item, value: int) -> StatusError:
        """Whether `value` is within the register's own range, or between the registers that limit it."""
        if item.range is not None and not item.range[0] <= value <= item.range[1]:
            return StatusError.DATA_RANGE
        if item.limits is not None:
            low, high = (-self.get(name[1:]) if name.startswith("-") else self.get(name) for name in item.limits)
            if not low <= value <= high:
                return StatusError.DATA_LIMIT
        return StatusError.NONE

    def _apply(self, writes: list[tuple[Item, int]] | StatusError, now_ns: int) -> None:
        assert not isinstance(writes, StatusError)
        for item, value in writes:
            self.memory[item.address : item.end] = item.encode(value)
            self.changed(item, value, now_ns)

    def _action(self, now_ns: int) -> StatusError:
        if self._registered is None:
            return StatusError.RESULT
        (address, data), self._registered = self._registered, None
        self._mark_registered()
        return self.write(address, data, now_ns)

    def _mark_registered(self) -> None:
        if "registered_instruction" in self.table:
            self.put("registered_instruction", int(self._registered is not None))

    def _factory_reset(self, params: bytes, now_ns: int) -> StatusError:
        if len(params) != 1 or params[0] not in _KEPT:
            return StatusError.DATA_RANGE
        values = {name: self.get(name) for name in ("firmware_version", "model_number", *_KEPT[Reset(params[0])])}
        self._load(lambda item: True)
        for name, value in values.items():
            self.put(name, value)
        self.reboot(now_ns)
        return StatusError.NONE

    def reboot(self, now_ns: int) -> None:
        """Lose RAM and be silent while starting."""
        self._load(lambda item: not item.eeprom)
        self._registered = None
        self._silent_until = now_ns + self.BOOT_NS
        self.restarted(now_ns)

    def power(self, on: bool, now_ns: int) -> None:
        """Switch the supply; RAM is lost with it."""
        if on and not self.powered:
            self._silent_until = now_ns + self.BOOT_NS
        if on is not self.powered:
            self._load(lambda item: not item.eeprom)
            self._registered = None
            self.powered = on
            self.restarted(now_ns)

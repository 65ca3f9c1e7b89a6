"""A control table in memory: registers by name, bytes by address, and what indirect addresses make of them."""

from __future__ import annotations

from collections.abc import Callable, Iterator

from servoid.hw.dynamixel.protocol.codec import StatusError
from servoid.hw.dynamixel.protocol.tables import ControlTable, Item


class Registers:
    """The memory of a device."""

    def __init__(self, table: ControlTable) -> None:
        self.table = table
        self.memory = bytearray(table.size)
        self._places = {name: (item.address, item.end, item.signed) for name, item in table.items.items()}
        self._starts = {item.address: item for item in table.items.values()}
        self._defined = frozenset(at for item in table.items.values() for at in range(item.address, item.end))
        self._pointers = {block.data + i: block.address + 2 * i for block in table.indirect for i in range(block.count)}
        self._first_pointer = min(self._pointers, default=len(self.memory))

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

    def load(self, which: Callable[[Item], bool]) -> None:
        """Set those registers to the factory's values."""
        for item in self.table.items.values():
            if which(item):
                self.memory[item.address : item.end] = item.encode(item.default or 0)

    def peek(self, address: int, length: int) -> bytes | None:
        """Bytes through indirect addresses where there are; None where the first is of no register, or the last beyond
        the table. Gaps between registers that are read in one block read zero."""
        if address not in self._defined or address + length > len(self.memory):
            return None
        data = bytearray(self.memory[address : address + length])
        if address + length > self._first_pointer:
            for at in range(max(address, self._first_pointer), address + length):
                pointer = self._pointers.get(at)
                if pointer is not None:
                    data[at - address] = self.memory[self._target(pointer, at)]
        return bytes(data)

    def resolve(self, address: int, data: bytes) -> list[tuple[Item, int]] | StatusError:
        """The registers that `data` at `address` sets and their new values, or why not."""
        if address + len(data) > len(self.memory):
            return StatusError.ACCESS
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

    def in_range(self, item: Item, value: int) -> StatusError:
        """Whether `value` is within the register's own range, or between the registers that limit it."""
        if item.range is not None and not item.range[0] <= value <= item.range[1]:
            return StatusError.DATA_RANGE
        if item.limits is not None:
            low, high = (-self.get(name[1:]) if name.startswith("-") else self.get(name) for name in item.limits)
            if not low <= value <= high:
                return StatusError.DATA_LIMIT
        return StatusError.NONE

    def _target(self, pointer: int, data: int) -> int:
        """Where an indirect data byte leads; one that points outside the table leads to itself."""
        target = int.from_bytes(self.memory[pointer : pointer + 2], "little")
        return target if target < len(self.memory) else data

    def _split(self, start: int, run: bytes) -> Iterator[tuple[Item | None, bytes]]:
        at = 0
        while at < len(run):
            item = self._starts.get(start + at)
            yield item, run[at : at + (item.width if item else 1)]
            at += item.width if item else 1

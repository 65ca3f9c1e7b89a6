"""The clients that `servoid bench bus` times: each writes 20 goals and reads 20 servos and the board in a cycle."""

from __future__ import annotations

import struct
from collections.abc import Sequence
from typing import Any, Protocol

import numpy as np

from servoid.hw.clock import WallClock
from servoid.hw.contracts.body import Array
from servoid.hw.dynamixel.protocol.codec import SyncWriter
from servoid.hw.dynamixel.transport.bus import Bus
from servoid.hw.dynamixel.transport.group_read import GroupRead
from servoid.hw.dynamixel.transport.port import SerialPort

GOAL, GOAL_BYTES = 116, 4
PRESENT, PRESENT_BYTES = 126, 10  # current, velocity, position
BOARD, BOARD_BYTES = 30, 20  # from the buttons to the IMU's angles
_FIELDS = np.dtype([("current", "<i2"), ("velocity", "<i4"), ("position", "<i4")])


class Client(Protocol):
    """A program that drives the bus."""

    def cycle(self, goals: Sequence[int]) -> Array | None:
        """Write the goals, read everybody; raw current, velocity and position `(3, n)`, or None where any is lost."""
        ...

    def close(self) -> None: ...


class Servoid:
    """This project's bus."""

    def __init__(self, port: str, baud: int, ids: Sequence[int], board: int, fast: bool) -> None:
        self._port = SerialPort(port, baud)
        self._bus = Bus(self._port, WallClock())
        self._present = GroupRead([(id, PRESENT, PRESENT_BYTES) for id in ids], fast=fast)
        self._board = GroupRead([(board, BOARD, BOARD_BYTES)])
        self._goals = SyncWriter(ids, GOAL, GOAL_BYTES, signed=True)

    def cycle(self, goals: Sequence[int]) -> Array | None:
        if self._bus.sync_read(self._present, self._board, before=self._goals.packet(goals)):
            return None
        raw = np.frombuffer(b"".join(self._present.data), _FIELDS)  # type: ignore[arg-type]
        return np.array([raw["current"], raw["velocity"], raw["position"]])

    def close(self) -> None:
        self._port.close()


class Sdk:
    """The official dynamixel-sdk, used as its examples do."""

    def __init__(self, port: str, baud: int, ids: Sequence[int], board: int, fast: bool) -> None:
        import dynamixel_sdk as sdk

        self._ids, self._board, self._fast = ids, board, fast
        self._port = sdk.PortHandler(port)
        if not (self._port.openPort() and self._port.setBaudRate(baud)):
            raise OSError(f"{port}: the SDK does not open it")
        self._packets: Any = sdk.Protocol2PacketHandler()
        self._write = sdk.GroupSyncWrite(self._port, self._packets, GOAL, GOAL_BYTES)
        self._read = sdk.GroupSyncRead(self._port, self._packets, PRESENT, PRESENT_BYTES)
        for id in ids:
            self._read.addParam(id)
            self._write.addParam(id, bytes(GOAL_BYTES))

    def cycle(self, goals: Sequence[int]) -> Array | None:
        for id, goal in zip(self._ids, goals, strict=True):
            self._write.changeParam(id, struct.pack("<i", goal))
        failed = self._write.txPacket()
        failed |= self._read.fastSyncRead() if self._fast else self._read.txRxPacket()
        _, result, error = self._packets.readTxRx(self._port, self._board, BOARD, BOARD_BYTES)
        if failed or result or error:
            return None
        get = self._read.getData
        return np.array(
            [
                [get(id, PRESENT, 2) for id in self._ids],
                [get(id, PRESENT + 2, 4) for id in self._ids],
                [get(id, PRESENT + 6, 4) for id in self._ids],
            ]
        )

    def close(self) -> None:
        self._port.closePort()


CLIENTS: dict[str, type[Servoid] | type[Sdk]] = {"servoid": Servoid, "sdk": Sdk}

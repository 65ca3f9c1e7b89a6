"""The official SDK on a virtual rig in this process: its packets, its parsing and its timeouts, in the rig's time."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Any

import dynamixel_sdk as sdk

from servoid.hw.robot.description import Robot
from servoid.sim.rig.in_process import InProcessLine
from servoid.sim.rig.rig import Rig
from servoid.sim.rig.servo.factory_state import FactoryState

_LATENCY_MS = 16.0  # that the SDK allows an adapter, twice
_BYTE_MS = 10_000.0  # of a byte at 1 bit/s
_POLL_NS = 20_000  # between two looks of a client that waits


class Refused(Exception):
    """A rig did not do what the client waits for."""


class RigPort:
    """What the SDK needs of its port handler, on the line of a rig."""

    def __init__(self, line: InProcessLine) -> None:
        self.is_using = False
        self._line, self._buffer = line, bytearray()
        self._until_ns = 0

    def getBaudRate(self) -> int:
        return self._line.baud

    def setBaudRate(self, baud: int) -> bool:
        self._line.set_baud(baud)
        return True

    def clearPort(self) -> None:
        self._hear()
        self._buffer.clear()

    def writePort(self, packet: Sequence[int]) -> int:
        self._line.write(bytes(packet))
        return len(packet)

    def readPort(self, length: int) -> bytes:
        """At most so many bytes, at once; a client that finds nothing lets some time pass."""
        if not self._buffer:
            self._line.sleep_until(self._line.now_ns() + _POLL_NS)
        self._hear()
        data = bytes(self._buffer[:length])
        del self._buffer[:length]
        return data

    def setPacketTimeout(self, length: int) -> None:
        self.setPacketTimeoutMillis(_BYTE_MS / self.getBaudRate() * length + 2.0 * _LATENCY_MS + 2.0)

    def setPacketTimeoutMillis(self, ms: float) -> None:
        self._until_ns = self._line.now_ns() + round(ms * 1e6)

    def isPacketTimeout(self) -> bool:
        return self._line.now_ns() > self._until_ns

    def _hear(self) -> None:
        self._buffer += self._line.read()


class SdkHost:
    """A client of the SDK. Methods raise Refused, saying what was asked, where the answer is none that it accepts."""

    def __init__(self, robot: Robot, factory_state: FactoryState) -> None:
        self.rig = Rig(robot, factory_state=factory_state)
        self.rig.auto_release = False  # on its stand: these clients' robots do not walk
        self._line = InProcessLine(self.rig)
        self.port, self.packets = RigPort(self._line), sdk.PacketHandler(2.0)
        self.port.setBaudRate(factory_state.bus_baud(robot))
        self.ids = [servo.id for servo in self.rig.servos if not servo.dead]
        self.wait(0.4)

    def wait(self, seconds: float) -> None:
        self._line.sleep_until(self._line.now_ns() + round(seconds * 1e9))

    def joint(self, id: int) -> str:
        """Name of the joint whose servo was set up with this ID."""
        return next(joint.name for joint in self.rig.robot.joints if joint.id == id)

    def check(self, what: str, result: int, error: int = 0) -> None:
        if result != sdk.COMM_SUCCESS:
            raise Refused(f"{what}: {self.packets.getTxRxResult(result)}")
        if error:
            raise Refused(f"{what}: {self.packets.getRxPacketError(error)}")

    def read(self, id: int, address: int, length: int, *, signed: bool = False) -> int:
        data, result, error = self.packets.readTxRx(self.port, id, address, length)
        self.check(f"ID {id}: read {address}", result, error)
        return int.from_bytes(bytes(data), "little", signed=signed)

    def write(self, id: int, address: int, length: int, value: int) -> None:
        data = list(value.to_bytes(length, "little", signed=value < 0))
        self.check(f"ID {id}: write {address}", *self.packets.writeTxRx(self.port, id, address, length, data))

    def sync_write(self, address: int, length: int, values: Mapping[int, int]) -> None:
        group = sdk.GroupSyncWrite(self.port, self.packets, address, length)
        for id, value in values.items():
            group.addParam(id, list(value.to_bytes(length, "little", signed=value < 0)))
        self.check(f"sync write {address}", group.txPacket())
        self.wait(0.001)

    def sync_read(
        self, ids: Sequence[int], address: int, length: int, *, signed: bool = False, fast: bool = False
    ) -> dict[int, int]:
        group = sdk.GroupSyncRead(self.port, self.packets, address, length)
        for id in ids:
            group.addParam(id)
        self.check(f"sync read {address}", group.fastSyncRead() if fast else group.txRxPacket())
        return {id: _value(group, id, address, length, signed) for id in ids}

    def bulk_read(self, parts: Sequence[tuple[int, int, int]], *, fast: bool = False) -> dict[int, int]:
        """Of (ID, address, length); unsigned."""
        group = sdk.GroupBulkRead(self.port, self.packets)
        for part in parts:
            group.addParam(*part)
        self.check("bulk read", group.fastBulkRead() if fast else group.txRxPacket())
        return {id: _value(group, id, address, length, False) for id, address, length in parts}

    def present(self, ids: Sequence[int]) -> dict[int, tuple[int, int, int]]:
        """Current, velocity and position by one bulk read of ten bytes, as these clients take it apart."""
        group = sdk.GroupBulkRead(self.port, self.packets)
        for id in ids:
            group.addParam(id, 126, 10)
        self.check("bulk read 126", group.txRxPacket())
        return {id: tuple(_value(group, id, *part, True) for part in ((126, 2), (128, 4), (132, 4))) for id in ids}  # type: ignore[misc]


def expect(what: str, found: object, wanted: object) -> None:
    """Raise Refused where they differ."""
    if found != wanted:
        raise Refused(f"{what}: {found}, expected {wanted}")


def near(what: str, found: float, wanted: float, margin: float) -> None:
    """Raise Refused where they are farther apart."""
    if abs(found - wanted) > margin:
        raise Refused(f"{what}: {found}, expected {wanted} within {margin}")


def _value(group: Any, id: int, address: int, length: int, signed: bool) -> int:
    if not group.isAvailable(id, address, length):
        raise Refused(f"ID {id}: no answer about {address}")
    value = int(group.getData(id, address, length))
    return value - (1 << 8 * length) if signed and value >> (8 * length - 1) else value

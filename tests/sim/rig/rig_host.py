"""A host on a rig in the same process: bytes in, packets out, in the rig's own time."""

from __future__ import annotations

from collections.abc import Sequence

from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.codec import PacketParser, Status, StatusError
from servoid.hw.dynamixel.protocol.tables import table
from servoid.hw.robot.description import Robot
from servoid.sim.rig.rig import Rig

XM430 = table("xm430-w350")
BOARD = 200


class Host:
    """Speaks to `rig` at the robot's baud. Times are seconds of the rig."""

    def __init__(self, rig: Rig, robot: Robot) -> None:
        self.rig, self.robot = rig, robot
        self.ids = [joint.id for joint in robot.joints]
        self.parser = PacketParser()
        rig.wire.host_baud = robot.bus.baud

    def start(self) -> None:
        """Switch the servos on and wait until they have booted."""
        self.ask(codec.write(BOARD, 24, b"\1"))
        self.wait(0.35)

    def wait(self, seconds: float) -> bytes:
        return self.rig.advance(self.rig.now_ns + round(seconds * 1e9))

    def ask(self, packet: bytes, seconds: float = 0.02) -> list[Status]:
        """Send a packet and wait; the statuses that came back."""
        self.rig.host_sends(packet)
        heard = self.wait(seconds)
        return [Status(p.id, p.params[0] & 127, p.params[0] > 127, p.params[1:]) for p in self.parser.feed(heard)]

    def one(self, packet: bytes) -> Status:
        """Send a packet that one device answers, and return its answer."""
        (status,) = self.ask(packet)
        return status

    def write(self, id: int, register: str, value: int) -> StatusError:
        item = XM430.item(register)
        return StatusError(self.one(codec.write(id, item.address, item.encode(value))).error)

    def read(self, id: int, register: str) -> int:
        item = XM430.item(register)
        status = self.one(codec.read(id, item.address, item.width))
        assert status.error == 0, status
        return item.decode(status.data)

    def write_all(self, register: str, values: Sequence[int], seconds: float = 0.004) -> None:
        item = XM430.item(register)
        data = {id: item.encode(value) for id, value in zip(self.ids, values, strict=True)}
        self.ask(codec.sync_write(item.address, item.width, data), seconds)

    def torque_on(self, ids: Sequence[int]) -> None:
        """Goal to the present position, then torque."""
        for id in ids:
            assert self.write(id, "goal_position", self.read(id, "present_position")) == 0
            assert self.write(id, "torque_enable", 1) == 0


__all__ = ["BOARD", "XM430", "Host"]

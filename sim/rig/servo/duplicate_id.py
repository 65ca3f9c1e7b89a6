"""A spare servo on the bus: it has the ID of another servo and moves nothing."""

from __future__ import annotations

from servoid.hw.dynamixel.protocol.codec import StatusError
from servoid.hw.dynamixel.protocol.tables import Item, table
from servoid.sim.rig.servo.device import VirtualDevice
from servoid.sim.rig.servo.virtual_servo import FIRMWARE

_POSITION = 1234  # ticks: nobody's home


class DuplicateId(VirtualDevice):
    """Registers without a motor. It takes every write that a servo would take with torque off."""

    def __init__(self, model: int | str, eeprom: dict[str, int]) -> None:
        super().__init__(table(model), {"firmware_version": FIRMWARE, **eeprom})
        self.put("present_position", _POSITION)

    def allowed(self, item: Item, value: int) -> StatusError:
        return self.in_range(item, value)

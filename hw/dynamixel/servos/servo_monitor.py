"""What goes wrong silently: torque that is off, a servo that restarted, an error behind an alert, heat, voltage.

Registers that a control cycle does not need are read in rotation, BLOCK servos a tick, so that every servo is looked at
within a few ticks; one whose answer carries the alert bit is looked at in the same tick.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.dynamixel.protocol.units import Units
from servoid.hw.dynamixel.servos.register_check import Found
from servoid.hw.dynamixel.transport.bus import Bus
from servoid.hw.dynamixel.transport.group_read import GroupRead
from servoid.hw.faults import REBOOTED, STOP_BUTTON, STOP_BUTTON_AGAIN, TORQUE_LOST, WATCHDOG

BLOCK = 4  # servos looked at in a tick
TRIPPED = 255  # what the watchdog register reads once it expired
_HOST_BITS = TORQUE_LOST | REBOOTED | WATCHDOG


class ServoMonitor:
    """Faults `(n_joints,)` as bits of servoid.hw.faults, and temperatures and voltages as they come in."""

    def __init__(self, bus: Bus, found: Sequence[Found], units: Units) -> None:
        n = len(found)
        self._bus, self._units = bus, units
        self._ids = [servo.joint.id for servo in found]
        blocks = [range(start, min(start + BLOCK, n)) for start in range(0, n, BLOCK)]
        first = found[0].table
        self._error, self._torque = first.item("hardware_error_status"), first.item("torque_enable")
        self._watchdog = first.item("bus_watchdog")
        start, length = self._torque.address, self._watchdog.end - self._torque.address
        self._voltage, self._heat = first.item("present_input_voltage"), first.item("present_temperature")
        slow, slow_length = self._voltage.address, self._heat.end - self._voltage.address
        self._monitors = [(b, GroupRead([(self._ids[i], start, length) for i in b])) for b in blocks]
        self._slow = [(b, GroupRead([(self._ids[i], slow, slow_length) for i in b])) for b in blocks]
        self._turn = 0
        self._pressed = False
        self.armed = False  # whether torque is meant to be on
        self.fault: Array = np.array([servo.get("hardware_error_status") for servo in found], dtype=np.int64)
        self.temperature: Array = np.full(n, np.nan)  # degrees C, of the newest look only
        self.voltage: Array = np.full(n, np.nan)  # V

    def look(self, alerts: Sequence[bool], *, hurry: bool = False) -> None:
        """One tick's look. `alerts` `(n_joints,)` are the alert bits of this tick's answers. In a `hurry`, when the
        tick was spent on waiting for a servo that is silent, only alerts are looked into."""
        self.temperature[:], self.voltage[:] = np.nan, np.nan
        if not hurry:
            self._monitor()
            self._measure()
        self._explain(alerts)

    def _monitor(self) -> None:
        block, group = self._monitors[self._turn]
        self._bus.sync_read(group, again=False)
        for i, data, fresh in zip(block, group.data, group.fresh, strict=True):
            if fresh and data is not None:
                self._judge(i, data)

    def _measure(self) -> None:
        block, group = self._slow[self._turn]
        self._turn = (self._turn + 1) % len(self._slow)
        self._bus.sync_read(group, again=False)
        for i, data, fresh in zip(block, group.data, group.fresh, strict=True):
            if fresh and data is not None:
                self.voltage[i] = self._voltage.decode(data)
                self.temperature[i] = data[self._heat.address - self._voltage.address]
        self.voltage = self._units.voltage(self.voltage)

    def _explain(self, alerts: Sequence[bool]) -> None:
        """Ask for the error behind an alert."""
        unexplained = [i for i, alert in enumerate(alerts) if alert and not self.fault[i] & 0xFF]
        for i in unexplained[:2]:  # the others next tick
            value = self._bus.read_item(self._ids[i], self._error, tries=1)
            if value is not None:
                self.fault[i] |= value

    def press(self, pressed: bool) -> None:
        """A stop button of the board is down or not. A press is not forgotten when it is let go, and the second one
        counts as another."""
        if pressed and not self._pressed:
            self.fault |= STOP_BUTTON_AGAIN if (self.fault & STOP_BUTTON).any() else STOP_BUTTON
        self._pressed = pressed

    def expect(self, armed: bool) -> None:
        """Torque was switched on or off on purpose: what was found before is no longer a fault."""
        self.armed = armed
        self.fault &= ~_HOST_BITS

    def _judge(self, i: int, data: bytes) -> None:
        start = self._torque.address
        error = data[self._error.address - start]
        self.fault[i] = (self.fault[i] & ~0xFF) | error
        if not self.armed:
            return
        watchdog = data[self._watchdog.address - start]
        if watchdog == TRIPPED:
            self.fault[i] |= WATCHDOG
        elif not data[0]:
            # The watchdog was armed with torque: a servo that no longer knows that has lost its RAM.
            self.fault[i] |= TORQUE_LOST if watchdog else REBOOTED

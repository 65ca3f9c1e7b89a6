"""Servo angles of a robot without torque, read until they stand still."""

from __future__ import annotations

from collections.abc import Callable, Sequence

import numpy as np

from servoid.hw.contracts.body import Array, BackendError, Clock
from servoid.hw.dynamixel.servos.register_check import Found
from servoid.hw.dynamixel.transport.bus import Bus
from servoid.hw.dynamixel.transport.group_read import GroupRead
from servoid.hw.robot.description import Robot

STILL = 0.02  # rad that an angle may change by within WINDOW samples and yet be still: above a hand's tremor
WINDOW = 15
PERIOD_NS = 30_000_000


class Encoders:
    """Servo angles `(n_joints,)` rad from the centre tick, in -pi..pi. Differences are the short way round."""

    def __init__(
        self,
        bus: Bus,
        clock: Clock,
        robot: Robot,
        found: Sequence[Found],
        seen: Callable[[Array], None] = lambda angles: None,
    ) -> None:
        """`seen` is told each sample."""
        self.names, self._bus, self._clock, self._seen = robot.names, bus, clock, seen
        self._group = GroupRead.of("present_position", {servo.joint.id: servo.table for servo in found})
        self._items = [s.table.item("present_position") for s in found]
        self._center = np.array([servo.center_tick for servo in robot.servos])
        self._tick = 2.0 * np.pi / np.array([servo.ticks_per_turn for servo in robot.servos])

    def read(self) -> Array:
        """One sample. Raises BackendError naming a servo that does not answer three times in a row."""
        for _ in range(3):
            self._clock.sleep_until(self._clock.now_ns() + PERIOD_NS)
            self._bus.sync_read(self._group)
            if all(self._group.fresh):
                ticks = [item.decode(data or b"") for item, data in zip(self._items, self._group.data, strict=True)]
                angles = short((np.array(ticks) - self._center) * self._tick)
                self._seen(angles)
                return angles
        silent = self.names[self._group.fresh.index(False)]
        raise BackendError(f"{silent} does not answer any more: check its cable and its power, then begin again")

    def still(self, patience: float) -> Array:
        """The mean of WINDOW samples in which nothing moved. Raises BackendError naming the joint that does."""
        end = self._clock.now_ns() + round(patience * 1e9)
        samples = [self.read() for _ in range(WINDOW)]
        while True:
            apart = short(np.array(samples) - samples[0])
            spread = np.ptp(apart, axis=0)
            if spread.max() <= STILL:
                return short(samples[0] + apart.mean(0))
            if self._clock.now_ns() >= end:
                worst = int(spread.argmax())
                raise BackendError(
                    f"{self.names[worst]} still moves by {spread[worst]:.2f} rad after {patience:g} s: support the "
                    "robot so that it keeps the pose, then begin again"
                )
            samples = [*samples[1:], self.read()]


def short(angle: Array) -> Array:
    """The same angle in -pi..pi."""
    return (angle + np.pi) % (2.0 * np.pi) - np.pi

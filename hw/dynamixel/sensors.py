"""One read of the robot: all joints in a cycle, the board's buttons, the IMU, and a few servos' silent registers."""

from __future__ import annotations

from collections import deque

import numpy as np

from servoid.hw.contracts.body import Observation
from servoid.hw.dynamixel.imu import BUTTONS, BoardImu
from servoid.hw.dynamixel.protocol.tables import table
from servoid.hw.dynamixel.protocol.units import Units
from servoid.hw.dynamixel.servos.register_check import Found
from servoid.hw.dynamixel.servos.servo_monitor import ServoMonitor
from servoid.hw.dynamixel.transport.bus import Bus
from servoid.hw.dynamixel.transport.group_read import GroupRead
from servoid.hw.faults import LATE
from servoid.hw.imu.mounting import Mounting
from servoid.hw.imu.reading import Reading
from servoid.hw.imu.serial_imu import SerialImu
from servoid.hw.robot.description import Robot

# Of the last ticks, answers came late in so many, or something was still missing after the second request in so many:
# that is no accident. An adapter that batches may let every sample through just before it counts as old.
LATE_SPAN, LATE_TICKS, SHORT_TICKS = 8, 4, 6
_PRESENT = np.dtype([("current", "<i2"), ("velocity", "<i4"), ("position", "<i4")])


def present(found: list[Found]) -> GroupRead:
    """The group of the control cycle: current (or load, where there is none), velocity and position of every servo,
    which lie side by side in every model."""
    parts = [(s.joint.id, s.table.item("present_position").end - _PRESENT.itemsize, _PRESENT.itemsize) for s in found]
    return GroupRead(parts, fast=all(map(_fast, found)))


class DynamixelSensors:
    """The reading half of the backend. `imu` is one on a port of its own; without it the board's is read."""

    def __init__(
        self,
        bus: Bus,
        robot: Robot,
        units: Units,
        monitor: ServoMonitor,
        present: GroupRead,
        imu: SerialImu | None = None,
    ) -> None:
        self._bus, self._units, self._monitor, self._present, self._imu = bus, units, monitor, present, imu
        self._block = BoardImu(table("opencr"), Mounting(robot.imu.signs, robot.imu.mounting))
        parts = [(robot.bus.board_id, self._block.address, self._block.length)] if robot.bus.board != "none" else []
        self._board = GroupRead(parts)
        self._no_imu = robot.imu.kind == "none"
        self._stop = sum({BUTTONS[name] for name in robot.bus.stop_buttons})
        self._late: deque[bool] = deque(maxlen=LATE_SPAN)
        self._short: deque[bool] = deque(maxlen=LATE_SPAN)

    def read(self) -> Observation:
        """All joints, the IMU, and a few servos' slow registers. A value that did not come at this tick is NaN."""
        bus, group = self._bus, self._present
        lost, stray = bus.counters.lost, bus.counters.stray
        bus.sync_read(*((group, self._board) if self._board.ids else (group,)))
        position, velocity, current = self._decode()
        reading = self._read_imu()
        self._monitor.press(self._block.buttons & self._stop != 0)
        self._monitor.look(group.alert, hurry=not all(group.fresh))
        self._late.append(bus.counters.lost > lost and bus.counters.stray > stray)
        self._short.append(not (all(self._board.fresh) and all(group.fresh)))
        late = LATE if sum(self._late) >= LATE_TICKS or sum(self._short) >= SHORT_TICKS else 0
        now = bus.clock.now_ns()
        return Observation(
            time_ns=now,
            position=self._units.position(position),
            velocity=self._units.velocity(velocity),
            effort=self._units.effort(current),
            temperature=self._monitor.temperature.copy(),
            voltage=self._monitor.voltage.copy(),
            age=np.array([_age(now, time) for time in group.time_ns]),
            fault=self._monitor.fault | reading.fault | late,
            orientation=reading.orientation,
            angular_velocity=reading.angular_velocity,
            specific_force=reading.specific_force,
            imu_age=np.asarray(np.nan if self._no_imu else _age(now, reading.time_ns)),
        )

    def _read_imu(self) -> Reading:
        """The IMU's newest sample; the board's buttons are in the same block. Without an IMU nothing, and no fault."""
        reading = Reading(None, 0)
        if self._board.ids:
            fresh = self._board.fresh[0]
            reading = self._block.update(self._board.data[0] if fresh else None, self._board.time_ns[0])
        if self._imu is not None:
            return self._imu.read()
        return Reading(None, 0) if self._no_imu else reading

    def _decode(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Raw position, velocity and current `(n_joints,)` as floats, NaN where they did not come."""
        rows = np.full((3, len(self._present.ids)), np.nan)
        came = [i for i, fresh in enumerate(self._present.fresh) if fresh]
        raw = np.frombuffer(b"".join(self._present.data[i] or b"" for i in came), dtype=_PRESENT)
        for row, field in zip(rows, ("position", "velocity", "current"), strict=True):
            row[came] = raw[field]
        return rows[0], rows[1], rows[2]


def _fast(servo: Found) -> bool:
    oldest = servo.table.fast_firmware
    return oldest is not None and servo.firmware >= oldest


def _age(now_ns: int, time_ns: int | None) -> float:
    return float("inf") if time_ns is None else (now_ns - time_ns) * 1e-9

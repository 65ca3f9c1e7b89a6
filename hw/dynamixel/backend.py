"""A robot of Dynamixel servos and an OpenCR board on one bus, behind the hardware contracts.

Connecting finds, powers, reads and compares; it never moves anything and never switches torque. A tick reads all
present values in one cycle and the board's IMU, and looks at a few servos' silent registers in rotation.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack

import numpy as np

from hw.clock import WallClock
from hw.dynamixel.bus import Bus, Counters
from hw.dynamixel.group import GroupRead
from hw.dynamixel.imu import BoardImu
from hw.dynamixel.lifeline import Lifeline
from hw.dynamixel.motors import DynamixelMotors
from hw.dynamixel.port import Port, SerialPort
from hw.dynamixel.survey import Difference, Found, as_table, compare, correct, find_board, find_servos
from hw.dynamixel.tables import table
from hw.dynamixel.units import Units
from hw.dynamixel.watch import Watch
from hw.hal import BackendError, Clock, Observation
from hw.robot import Robot

_PRESENT = np.dtype([("current", "<i2"), ("velocity", "<i4"), ("position", "<i4")])


class DynamixelBackend:
    """`port` is a path, or an open port. `fix` lets connect correct registers that differ from the robot's file;
    `exact` refuses a robot with any such difference, and not only with a grave one.

    On a real port a guardian process stands by from connect to close, for the case that this process is killed.
    """

    def __init__(
        self,
        robot: Robot,
        *,
        port: str | Port | None = None,
        clock: Clock | None = None,
        fix: bool = False,
        exact: bool = False,
        name: str = "dynamixel",
        opener: Callable[[str, int], Port] = SerialPort,
    ) -> None:
        self.name = name
        self.clock: Clock = clock or WallClock()
        self.differences: tuple[Difference, ...] = ()
        self._robot, self._given, self._fix, self._exact, self._open = robot, port, fix, exact, opener
        self._port: Port | None = None
        self._bus: Bus | None = None
        self._motors: DynamixelMotors | None = None
        self._lifeline: Lifeline | None = None

    @property
    def counters(self) -> Counters:
        """Of the bus, since it was opened."""
        return self._bus.counters if self._bus else Counters()

    def connect(self) -> tuple[DynamixelSensors, DynamixelMotors]:
        """Find the robot and check it. Raises BackendError with the remedy, and leaves the port closed."""
        if self._port is not None:
            raise BackendError(f"{self._port.name}: connected already")
        if self._given is None:
            raise BackendError(f"backend '{self.name}' needs a port: name it with --port")
        port = self._open(self._given, self._robot.bus.baud) if isinstance(self._given, str) else self._given
        self._port = port
        try:
            return self._connect(Bus(port, self.clock))
        except BaseException:
            self.close()
            raise

    def _connect(self, bus: Bus) -> tuple[DynamixelSensors, DynamixelMotors]:
        bus.return_delay = 254 * 2e-6  # until the servos' own is known
        find_board(bus, self._robot)
        found = find_servos(bus, self._robot)
        differences = compare(self._robot, found)
        if differences and self._fix:
            correct(bus, found, differences)
            found = find_servos(bus, self._robot)
            differences = compare(self._robot, found)
        self.differences = tuple(differences)
        if any(difference.grave or self._exact for difference in differences):
            error = BackendError(
                f"{len(differences)} registers are not as {self._robot.name} needs them, the first of "
                f"{differences[0].joint}: let `servoid bringup check --fix` correct them"
            )
            error.add_note(as_table(differences))
            raise error
        bus.return_delay = max(servo.get("return_delay_time") for servo in found) * 2e-6
        units = Units(self._robot, [servo.table for servo in found])
        watch = Watch(bus, found, units)
        present = GroupRead([_present(servo) for servo in found], fast=all(map(_fast, found)))
        ids = [servo.joint.id for servo in found]
        if isinstance(bus.port, SerialPort):
            self._lifeline = Lifeline(bus.port, ids, found[0].table, bus.return_delay)
        self._motors = DynamixelMotors(bus, found, units, watch, present, self._lifeline)
        self._bus = bus
        return DynamixelSensors(bus, self._robot, units, watch, present), self._motors

    def close(self) -> None:
        """Torque off, acknowledged, and the port given back. Raises BackendError when torque may still be on: the
        guardian has tried, too, by then."""
        port, motors, lifeline = self._port, self._motors, self._lifeline
        self._port = self._motors = self._lifeline = None
        with ExitStack() as stack:  # each step, whatever the one before it raises
            if port is not None:
                stack.callback(port.close)
            if lifeline is not None:
                stack.callback(lifeline.close)
            if motors is not None and motors.on:
                motors.off()


class DynamixelSensors:
    """The reading half of the backend."""

    def __init__(self, bus: Bus, robot: Robot, units: Units, watch: Watch, present: GroupRead) -> None:
        self._bus, self._units, self._watch, self._present = bus, units, watch, present
        self._imu = BoardImu(table("opencr"), np.array(robot.imu.signs))
        self._board = GroupRead([(robot.bus.board_id, self._imu.address, self._imu.length)])
        self._imu_time: int | None = None

    def read(self) -> Observation:
        """All joints, the IMU, and a few servos' slow registers. A value that did not come at this tick is NaN."""
        bus, present = self._bus, self._present
        lost = bus.read_group(present)
        position, velocity, current = self._decode()
        bus.read_group(self._board)
        alive = self._imu.update(self._board.data[0] if self._board.fresh[0] else None)
        if alive:
            self._imu_time = self._board.time_ns[0]
        self._watch.press(self._imu.buttons != 0)
        self._watch.look(present.alert, hurry=lost > 0)
        now = bus.clock.now_ns()
        return Observation(
            time_ns=now,
            position=self._units.position(position),
            velocity=self._units.velocity(velocity),
            effort=self._units.effort(current),
            temperature=self._watch.temperature.copy(),
            voltage=self._watch.voltage.copy(),
            age=np.array([_age(now, time) for time in present.time_ns]),
            fault=self._watch.fault.copy(),
            orientation=np.full(4, np.nan),
            angular_velocity=self._imu.angular_velocity,
            specific_force=self._imu.specific_force,
            imu_age=np.asarray(_age(now, self._imu_time)),
        )

    def _decode(self) -> tuple[np.ndarray, np.ndarray, np.ndarray]:
        """Raw position, velocity and current `(n_joints,)` as floats, NaN where they did not come."""
        rows = np.full((3, len(self._present.ids)), np.nan)
        came = [i for i, fresh in enumerate(self._present.fresh) if fresh]
        raw = np.frombuffer(b"".join(self._present.data[i] or b"" for i in came), dtype=_PRESENT)
        for row, field in zip(rows, ("position", "velocity", "current"), strict=True):
            row[came] = raw[field]
        return rows[0], rows[1], rows[2]


def _present(servo: Found) -> tuple[int, int, int]:
    """Current (or load, where there is none), velocity and position, which lie side by side in every model."""
    last = servo.table.item("present_position")
    return servo.joint.id, last.end - _PRESENT.itemsize, _PRESENT.itemsize


def _fast(servo: Found) -> bool:
    oldest = servo.table.fast_firmware
    return oldest is not None and servo.firmware >= oldest


def _age(now_ns: int, time_ns: int | None) -> float:
    return float("inf") if time_ns is None else (now_ns - time_ns) * 1e-9

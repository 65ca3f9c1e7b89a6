"""A robot of Dynamixel servos and an OpenCR board on one bus, behind the hardware contracts.

Connecting finds, powers, reads and compares; it never moves anything and never switches torque. A tick reads all
present values in one cycle and the board's IMU, and looks at a few servos' silent registers in rotation.
"""

from __future__ import annotations

from collections.abc import Callable
from contextlib import ExitStack

from servoid.hw.clock import WallClock
from servoid.hw.contracts.backend import Simulation
from servoid.hw.contracts.body import BackendError, Clock
from servoid.hw.dynamixel.guardian_client import Lifeline
from servoid.hw.dynamixel.motors import DynamixelMotors, TorqueUnproven
from servoid.hw.dynamixel.protocol.units import Units
from servoid.hw.dynamixel.sensors import DynamixelSensors, present
from servoid.hw.dynamixel.servos.register_check import Difference, as_table, compare, correct, find_board, find_servos
from servoid.hw.dynamixel.servos.servo_monitor import ServoMonitor
from servoid.hw.dynamixel.transport.bus import LONGEST_RETURN_DELAY, Bus, Counters
from servoid.hw.dynamixel.transport.port import Port, SerialPort
from servoid.hw.imu.serial_imu import SerialImu
from servoid.hw.robot.description import Robot


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
        self.simulation: Simulation | None = None  # it moves metal
        self.differences: tuple[Difference, ...] = ()
        self._robot, self._given, self._fix, self._exact, self._open = robot, port, fix, exact, opener
        self._port: Port | None = None
        self._bus: Bus | None = None
        self._motors: DynamixelMotors | None = None
        self._lifeline: Lifeline | None = None
        self._imu: SerialImu | None = None  # where it has a port of its own

    @property
    def counters(self) -> Counters:
        """Of the bus, since it was opened."""
        return self._bus.counters if self._bus else Counters()

    def connect(self) -> tuple[DynamixelSensors, DynamixelMotors]:
        """Find the robot and check it. Raises BackendError with the remedy, and leaves the port closed."""
        if self._port is not None:
            raise BackendError(f"{self._port.name}: already connected")
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
        if self._robot.imu.kind not in ("opencr", "none"):
            self._imu = SerialImu(self._robot.imu, self._robot.rate, clock=self.clock)
        bus.return_delay = LONGEST_RETURN_DELAY  # until the servos' own is known
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
                f"{len(differences)} registers differ from what {self._robot.name} needs, the first on "
                f"{differences[0].joint}: correct them with `servoid bringup check --fix`"
            )
            error.add_note(as_table(differences))
            raise error
        bus.return_delay = max(servo.get("return_delay_time") for servo in found) * 2e-6
        units = Units(self._robot, [servo.table for servo in found])
        units.anchor([servo.get("present_position") for servo in found])
        monitor = ServoMonitor(bus, found, units)
        group = present(found)
        ids = [servo.joint.id for servo in found]
        if isinstance(bus.port, SerialPort):
            self._lifeline = Lifeline(bus.port, ids, found[0].table, bus.return_delay)
        self._motors = DynamixelMotors(bus, found, units, monitor, group, self._lifeline)
        self._bus = bus
        return DynamixelSensors(bus, self._robot, units, monitor, group, self._imu), self._motors

    def close(self) -> None:
        """Torque off, acknowledged, and the port given back. Raises BackendError when torque may still be on: the
        guardian has tried, too, by then."""
        port, motors, lifeline, imu = self._port, self._motors, self._lifeline, self._imu
        self._port = self._motors = self._lifeline = self._imu = None
        failure: TorqueUnproven | None = None
        with ExitStack() as stack:  # each step, whatever the one before it raises
            if imu is not None:
                stack.callback(imu.close)
            if port is not None:
                stack.callback(port.close)
            try:
                if motors is not None and motors.on:
                    motors.off()
            except TorqueUnproven as error:
                failure = error
            finally:
                if lifeline is not None and lifeline.close() and motors is not None:
                    motors.proven("acknowledged to the guardian")
            if failure is not None and motors is not None and motors.on:
                raise failure

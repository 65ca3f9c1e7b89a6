"""A virtual rig in the process of its controller: its line as a port, its time as a clock, and a body on both.

Bytes, wire and servos are those of the rig in a process of its own (`backend`); only the tty and the control socket
between are left out. It is several times quicker, for runs by the hundred.
"""

from __future__ import annotations

from servoid.hw.contracts.backend import Simulation
from servoid.hw.contracts.body import Array, BackendError, Clock
from servoid.hw.dynamixel.backend import DynamixelBackend
from servoid.hw.dynamixel.motors import DynamixelMotors
from servoid.hw.dynamixel.sensors import DynamixelSensors
from servoid.hw.robot.description import Robot
from servoid.sim.rig.rig import Rig
from servoid.sim.rig.servo.board import on_the_board
from servoid.sim.rig.wire.faults import Fault, Scenario

_TOGETHER_NS = 80_000_000  # after which ticks of 20 ms and batches of 16 ms begin together again


class InProcessLine:
    """The rig's line as a Port, and its time as a Clock, which sleeping lets pass.

    A port that vanished or an adapter that takes nothing more fails as a real one does on Linux.
    """

    name = "rig"

    def __init__(self, rig: Rig) -> None:
        self.rig, self._heard = rig, b""
        rig.wire.host_baud = rig.robot.bus.baud

    @property
    def baud(self) -> int:
        return self.rig.wire.host_baud

    def set_baud(self, baud: int) -> None:
        self.rig.wire.host_baud = baud

    def now_ns(self) -> int:
        return self.rig.now_ns

    def sleep_until(self, time_ns: int) -> None:
        if time_ns > self.rig.now_ns:
            self._heard += self.rig.advance(time_ns)
            if self.rig.skew_ns:
                skew, self.rig.skew_ns = self.rig.skew_ns, 0
                self._heard += self.rig.advance(self.rig.now_ns + skew)

    def write(self, data: bytes) -> None:
        self._check()
        if self.rig.stalled:
            raise BackendError(f"{self.name}: the adapter takes no more bytes")
        self.rig.host_sends(data)

    def read(self) -> bytes:
        heard, self._heard = self._heard, b""
        if not heard:
            self._check()
        return heard

    def close(self) -> None: ...

    def _check(self) -> None:
        if not self.rig.port_open:
            raise BackendError(f"{self.name}: the port is gone")


class InProcessBackend:
    """The hardware backend on `rig`, reset to the robot, the noise and the dice of a seed, without faults.

    The truth is the rig's own.
    """

    name = "virtual"

    def __init__(self, rig: Rig, *, seed: int = 0) -> None:
        self.rig = rig
        # Ticks and an adapter's batches fall together as in every run before: what happens does not depend on those.
        rig.advance(-(-rig.now_ns // _TOGETHER_NS) * _TOGETHER_NS)
        rig.scenario = Scenario(seed=seed)
        rig.reset(seed)
        self._line = InProcessLine(rig)
        self.clock: Clock = self._line
        self.simulation = Simulation(rig.plant.truth, self.push)
        self._body = DynamixelBackend(on_the_board(rig.robot), port=self._line, clock=self._line, name=self.name)

    def connect(self) -> tuple[DynamixelSensors, DynamixelMotors]:
        """Find the servos, and wait for a step of physics that ticks may begin on. Raises BackendError."""
        handles = self._body.connect()
        period = round(self.rig.robot.dt * 1e9)
        self._line.sleep_until(-(-self._line.now_ns() // period) * period)
        return handles

    def push(self, velocity: Array) -> None:
        """Change the base's velocity by `(2,)` m/s, world frame."""
        self.rig.plant.push(velocity)

    def inject(self, kind: str, *, until: float | None = None, **values: object) -> None:
        """Inject a fault now, `until` [s] from now."""
        now = self.rig.seconds
        end = None if until is None else now + until
        self.rig.inject(Fault(kind, at=now, until=end, **values))  # type: ignore[arg-type]

    def close(self) -> None:
        """Torque off, acknowledged. Raises BackendError when torque may still be on."""
        self._body.close()

    @property
    def robot(self) -> Robot:
        return self.rig.robot

"""The virtual rig as a body: the hardware backend itself, opened on the serial port of a rig in a process of its own.

Between the loop and physics are real bytes, at the speed of a real line; only time is the rig's, which stands still
while the controller thinks, so that a run comes out the same every time.
"""

from __future__ import annotations

from collections.abc import Callable
from functools import partial

import numpy as np

from servoid.hw.contracts.backend import Simulation
from servoid.hw.contracts.body import Array, BackendError, Clock
from servoid.hw.contracts.world import Scene, Start, Truth
from servoid.hw.dynamixel.backend import DynamixelBackend
from servoid.hw.dynamixel.motors import DynamixelMotors
from servoid.hw.dynamixel.sensors import DynamixelSensors
from servoid.hw.robot.description import Robot
from servoid.sim.rig.process.control import Control, LockedClock, RigProcess, RigTruth
from servoid.sim.rig.servo.board import on_the_board
from servoid.sim.scene import Stage


class VirtualBackend:
    """A robot of emulated servos, the same draw as `servoid.sim.backend.SimBackend` makes of a seed.

    `truth`, `push` and `stage`, the scene in play, are for evaluation alone; they go over the rig's control socket and
    never over its bus.
    """

    name = "virtual"
    clock: Clock

    def __init__(
        self,
        robot: Robot,
        *,
        seed: int = 0,
        randomise: bool = False,
        scene: Scene | None = None,
        start: Start | None = None,
    ) -> None:
        """`start` says how the robot is let go, in one row."""
        self.clock = self._clock = VirtualClock()
        self.truth: Truth = VirtualTruth(self)
        self._robot, self._seed, self._randomise, self._start = robot, seed, randomise, start
        self.stage = None if scene is None else Stage(scene, self.truth, robot.dt, self._roll)
        self.simulation = Simulation(self.truth, self.push, self.stage)
        self._rig: RigProcess | None = None
        self._rig_truth: RigTruth | None = None
        self._body: DynamixelBackend | None = None

    @property
    def rig(self) -> RigProcess:
        """The rig. Raises BackendError when not connected."""
        if self._rig is None:
            raise BackendError("the virtual rig is not connected")
        return self._rig

    def connect(self) -> tuple[DynamixelSensors, DynamixelMotors]:
        """Start the rig and find its servos. The robot is held just above the floor until all servos have torque.

        Raises BackendError when the rig does not start or is not as the robot's file says; nothing is left behind.
        """
        if self._rig is not None:
            raise BackendError("the virtual rig is already connected")
        try:
            rig = self._rig = RigProcess(on_the_board(self._robot), seed=self._seed, randomise=self._randomise)
            if self.stage is not None:
                rig.control.furnish(self.stage.scene, self._seed, randomise=self._randomise)
            if self._start is not None:
                rig.control.lay(self._start)
            self._rig_truth = rig.truth(None if self.stage is None else self.stage.scene)
            self._clock.attach(rig)
            self._body = DynamixelBackend(on_the_board(self._robot), port=rig.port, clock=self.clock, name=self.name)
            handles = self._body.connect()
        except BaseException:
            self.close()
            raise
        # Ticks begin on a step of physics, as in simulation: a goal then acts from the same step on.
        period = round(self._robot.dt * 1e9)
        self.clock.sleep_until(-(-self.clock.now_ns() // period) * period)
        return handles

    def push(self, velocity: Array) -> None:
        """Change the base's velocity by `(2,)` m/s, world frame, before time goes on."""
        self._clock.requests.append(partial(Control.push, velocity=np.array(velocity, dtype=float)))

    def _roll(self, places: Array) -> None:
        self._clock.requests.append(partial(Control.roll, places=places))

    def close(self) -> None:
        """Torque off, acknowledged, then the end of the rig. Raises BackendError when torque may still be on."""
        rig, body = self._rig, self._body
        self._rig = self._body = self._rig_truth = None
        try:
            if body is not None:
                body.close()
        finally:
            self._clock.detach()
            if rig is not None:
                rig.close()

    def _fetch(self) -> Truth:
        if self._rig_truth is None:
            raise BackendError("the virtual rig is not connected: it has no truth")
        self._clock.deliver()
        return self._rig_truth.fetch()


class VirtualClock:
    """The locked time of a rig [ns]; 0 before it is attached, and standing still once it is detached.

    Requests wait here until time goes on: whoever makes one may be broken off by a second Ctrl-C, which must not cut it
    in half on its way to the rig.
    """

    def __init__(self) -> None:
        self.requests: list[Callable[[Control], None]] = []
        self._rig: RigProcess | None = None
        self._locked: LockedClock | None = None
        self._last = 0

    def attach(self, rig: RigProcess) -> None:
        self._rig, self._locked = rig, LockedClock(rig.control)

    def detach(self) -> None:
        self._last = self.now_ns()
        self._rig = self._locked = None
        self.requests.clear()

    def now_ns(self) -> int:
        return self._last if self._locked is None else self._locked.now_ns()

    def sleep_until(self, time_ns: int) -> None:
        """Let the rig live until then. Raises BackendError when the rig is gone."""
        if self._locked is None:
            raise BackendError("the virtual rig is not connected: its time stands still")
        self.deliver()
        self._locked.sleep_until(time_ns)

    def deliver(self) -> None:
        """Send the requests that wait."""
        while self.requests and self._rig is not None:
            self.requests.pop(0)(self._rig.control)


class VirtualTruth:
    """A live view of the truth about a rig's robot, fetched once for each instant that somebody looks.

    Raises BackendError when the rig is not connected.
    """

    def __init__(self, backend: VirtualBackend) -> None:
        self._backend = backend
        self._time: int | None = None
        self._truth: Truth | None = None

    def _now(self) -> Truth:
        clock = self._backend._clock
        if self._truth is None or self._time != clock.now_ns() or clock.requests:
            self._truth, self._time = self._backend._fetch(), clock.now_ns()
        return self._truth

    @property
    def position(self) -> Array:
        """Base position `(1, 3)` m."""
        return self._now().position

    @property
    def orientation(self) -> Array:
        """Base quaternion `(1, 4)` w x y z."""
        return self._now().orientation

    @property
    def yaw(self) -> Array:
        """Heading `(1,)` rad in -pi..pi."""
        return self._now().yaw

    @property
    def gravity(self) -> Array:
        """Unit vector along gravity in the base frame `(1, 3)`."""
        return self._now().gravity

    @property
    def velocity(self) -> Array:
        """Base velocity `(1, 3)` m/s in the heading frame."""
        return self._now().velocity

    @property
    def angular_velocity(self) -> Array:
        """Base angular velocity `(1, 3)` rad/s in the base frame."""
        return self._now().angular_velocity

    @property
    def fallen(self) -> Array:
        """Whether the robot has fallen `(1,)`."""
        return self._now().fallen

    @property
    def grounded(self) -> Array:
        """Whether the robot touches the ground with anything but its feet `(1,)`."""
        return self._now().grounded

    @property
    def joints(self) -> Array:
        """Joint positions `(1, n_joints)` rad."""
        return self._now().joints

    @property
    def objects(self) -> Array:
        """The scene's objects as they are `(1, objects, 7)`: x, y, z m of the middle, quaternion w x y z."""
        return self._now().objects

    @property
    def touching(self) -> Array:
        """Whether the robot touches an obstacle of the scene, or did within the last tick `(1,)`."""
        return self._now().touching

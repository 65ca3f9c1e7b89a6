"""A small body for tests of the stack: joints that follow their goals at once, on a clock that only they move."""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servoid.hw.contracts.backend import Simulation
from servoid.hw.contracts.body import Array, BackendError, Command, Mode, Motors, Observation, Sensors
from servoid.hw.contracts.control import State
from servoid.hw.robot.description import Robot


class ManualClock:
    """Time that passes only in `sleep_until`."""

    def __init__(self) -> None:
        self.now = 0

    def now_ns(self) -> int:
        return self.now

    def sleep_until(self, time_ns: int) -> None:
        self.now = max(self.now, time_ns)


class FakeBody:
    """A backend. `spoil`, if set, changes each observation; `sent` is every command that was written."""

    name = "fake"
    simulation: Simulation | None = None

    def __init__(self, robot: Robot, start: Array | None = None) -> None:
        self.robot = robot
        self.clock = ManualClock()
        self.position = np.array(robot.home if start is None else start, dtype=float)
        self.sent: list[Command] = []
        self.spoil = lambda observation: observation
        self.unreachable = False
        self.closed = False

    def connect(self) -> tuple[Sensors, Motors]:
        return self, self

    def close(self) -> None:
        self.closed = True

    def read(self) -> Observation:
        if self.unreachable:
            raise BackendError("the cable is out")
        return self.spoil(observation(self.robot, self.clock.now_ns(), self.position))

    def write(self, command: Command) -> None:
        if self.unreachable:
            raise BackendError("the cable is out")
        self.sent.append(command)
        if command.mode is Mode.ACTIVE:
            self.position = command.position.copy()


def observation(robot: Robot, time_ns: int, position: Array) -> Observation:
    """A clean observation of a body that is upright and still."""
    n = len(robot.names)
    return Observation(
        time_ns=time_ns,
        position=position.copy(),
        velocity=np.zeros(n),
        effort=np.zeros(n),
        temperature=np.full(n, 30.0),
        voltage=np.full(n, 12.0),
        age=np.zeros(n),
        fault=np.zeros(n, dtype=int),
        orientation=np.array([1.0, 0.0, 0.0, 0.0]),
        angular_velocity=np.zeros(3),
        specific_force=np.array([0.0, 0.0, 9.81]),
        imu_age=np.asarray(0.0),
    )


def tilted(observation: Observation, angle: float) -> Observation:
    """The same, rolled by `angle` rad."""
    return replace(observation, orientation=np.array([np.cos(angle / 2), np.sin(angle / 2), 0.0, 0.0]))


def spoiled(observation: Observation, joints: Array | list[int]) -> Observation:
    """The same, with these joints not read."""
    position = observation.position.copy()
    position[joints] = np.nan
    return replace(observation, position=position)


def tilt_of(gravity_z: float) -> Array:
    return np.array([0.0, np.sqrt(max(0.0, 1.0 - gravity_z**2)), gravity_z])


class StillEstimator:
    """States of a robot that stands where it began, tilted as its IMU's own fusion says."""

    def __init__(self, robot: Robot) -> None:
        self.robot = robot
        self.resets = 0
        self.ticks: list[int] = []  # that each update was told

    def reset(self) -> None: ...

    def reset_odometry(self) -> None:
        self.resets += 1

    def fall(self) -> None: ...

    def stand(self) -> None: ...

    def update(self, observation: Observation, applied: Array, ticks: int = 1) -> State:
        self.ticks.append(ticks)
        return State(
            time_ns=observation.time_ns,
            orientation=observation.orientation,
            gravity=tilt_of(2.0 * float(observation.orientation[1:3] @ observation.orientation[1:3]) - 1.0),
            yaw=np.asarray(0.0),
            angular_velocity=observation.angular_velocity,
            velocity=np.zeros(3),
            displacement=np.array([0.0, 0.0, self.robot.standing_height]),
            position=observation.position,
            joint_velocity=observation.velocity,
            contact=np.ones(2),
        )

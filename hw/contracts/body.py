"""A body: what every backend (simulated, virtual or real) is read as and driven by.

Every body is read as an `Observation` and driven by a `Command`; everything above works on the `State` that the
estimator makes of observations. Arrays follow the robot's joint order and may carry leading world dimensions:
`(..., n_joints)`. A value that was not read is NaN, never zero and never invented.
"""

from __future__ import annotations

from dataclasses import dataclass
from enum import IntEnum
from typing import Any, Protocol

import numpy.typing as npt

Array = npt.NDArray[Any]


class Mode(IntEnum):
    """What a motor does with a command."""

    OFF = 0  # torque off: the joint is free
    DAMP = 1  # gains at zero with torque on: the motor brakes
    ACTIVE = 2  # track the position target


@dataclass(frozen=True, slots=True)
class Observation:
    """One read of a body.

    `fault` holds the bits of the servos' hardware-error register (0: none). `age` is the time since a joint's sample
    was taken, infinite if it never was.
    """

    time_ns: int  # monotonic
    position: Array  # (..., n_joints) rad
    velocity: Array  # (..., n_joints) rad/s
    effort: Array  # (..., n_joints) N m
    temperature: Array  # (..., n_joints) degrees C
    voltage: Array  # (..., n_joints) V
    age: Array  # (..., n_joints) s
    fault: Array  # (..., n_joints) int
    orientation: Array  # (..., 4) quaternion w x y z of the IMU's own fusion
    angular_velocity: Array  # (..., 3) rad/s, base frame
    specific_force: Array  # (..., 3) m/s2, base frame: +9.81 on z when level and still
    imu_age: Array  # (...,) s; NaN: the robot has no IMU


@dataclass(frozen=True, slots=True)
class Command:
    """PD targets. `gain` scales the firmware's position gain (1: as configured); it is not in N m/rad."""

    position: Array  # (..., n_joints) rad
    gain: Array  # (..., n_joints)
    mode: Mode


class Sensors(Protocol):
    """The reading half of a backend."""

    def read(self) -> Observation:
        """Return the newest observation. Raises BackendError when the body cannot be reached."""
        ...


class Motors(Protocol):
    """The writing half of a backend. Only the guard holds one."""

    def write(self, command: Command) -> None:
        """Send a command. Raises BackendError when the body cannot be reached."""
        ...


class Clock(Protocol):
    """Monotonic time: the machine's, a simulation's, or a virtual rig's."""

    def now_ns(self) -> int: ...

    def sleep_until(self, time_ns: int) -> None:
        """Return at `time_ns`, or at once when it has passed."""
        ...


class BackendError(Exception):
    """A body cannot be reached or refused: exit code 3."""

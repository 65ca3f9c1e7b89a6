"""What differs from one simulated robot to the next: drawn once an episode, nominal or randomised."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot

# Ranges of the randomised robot. Where a nominal value follows, they are those of an XM430-W350 and of the IMU of an
# OP3-class robot: another one's range is as much wider or narrower as its own value is greater or smaller.
STIFFNESS, _STIFFNESS = (5.0, 19.0), 9.4  # N m/rad at the servo's nominal voltage
VOLTAGE, _VOLTAGE = (11.0, 12.6), 12.0  # V
FRICTION, _FRICTION = (0.4, 1.2), 0.8  # of the floor
MASS = (0.9, 1.1)  # factor on each body
COMMAND_DELAY, _COMMAND_DELAY = (0.008, 0.040), 0.020  # s
LATENCY, _LATENCY = (0.0, 0.012), 0.004  # s, of joints and of the IMU, each its own
ZERO = 0.03  # rad, half-width
BACKLASH = np.deg2rad(0.25)  # rad, whole play of a gear
IMU_TILT = 0.02  # rad, half-width of the mounting error about x and y


@dataclass(frozen=True, slots=True)
class Body:
    """One robot. Figures of servos are those of the first joint's: other servos differ from it as their files say.
    `mass` is `(n_bodies,)`, `zero` `(n_joints,)`, biases and tilt `(3,)` and `(2,)`."""

    stiffness: float
    voltage: float
    friction: float
    mass: Array
    command_delay: float
    joint_latency: float
    imu_latency: float
    zero: Array
    backlash: float
    gyro_bias: Array
    accelerometer_bias: Array
    imu_tilt: Array


def draw(rng: np.random.Generator, robot: Robot, n_bodies: int, randomise: bool) -> Body:
    """Draw a robot. The sensors' biases differ on the nominal robot too: no IMU is without."""
    imu, servo, n = robot.imu, robot.servos[0], len(robot.joints)
    gyro = rng.uniform(-imu.gyro_bias, imu.gyro_bias, 3)
    accelerometer = rng.uniform(-imu.accelerometer_bias, imu.accelerometer_bias, 3)
    if not randomise:
        return Body(
            stiffness=servo.stiffness,
            voltage=robot.bus.supply_voltage or servo.voltage,
            friction=robot.floor_friction,
            mass=np.ones(n_bodies),
            command_delay=servo.command_delay,
            joint_latency=servo.position_latency,
            imu_latency=imu.latency,
            zero=np.zeros(n),
            backlash=0.0,
            gyro_bias=gyro,
            accelerometer_bias=accelerometer,
            imu_tilt=np.zeros(2),
        )
    return Body(
        stiffness=rng.uniform(*STIFFNESS) * (servo.stiffness / _STIFFNESS),
        voltage=rng.uniform(*VOLTAGE) * ((robot.bus.supply_voltage or servo.voltage) / _VOLTAGE),
        friction=rng.uniform(*FRICTION) * (robot.floor_friction / _FRICTION),
        mass=rng.uniform(*MASS, n_bodies),
        command_delay=rng.uniform(*COMMAND_DELAY) * (servo.command_delay / _COMMAND_DELAY),
        joint_latency=rng.uniform(*LATENCY) * (servo.position_latency / _LATENCY),
        imu_latency=rng.uniform(*LATENCY) * (imu.latency / _LATENCY),
        zero=rng.uniform(-ZERO, ZERO, n),
        backlash=BACKLASH,
        gyro_bias=gyro,
        accelerometer_bias=accelerometer,
        imu_tilt=rng.uniform(-IMU_TILT, IMU_TILT, 2),
    )


def longest(robot: Robot) -> tuple[float, float]:
    """The longest command delay and the longest latency that `draw` gives this robot [s]."""
    first = robot.servos[0]
    later = max(servo.command_delay for servo in robot.servos) - first.command_delay
    older = max(servo.position_latency for servo in robot.servos) - first.position_latency
    latency = max(first.position_latency, robot.imu.latency)
    delay = COMMAND_DELAY[1] * (first.command_delay / _COMMAND_DELAY)
    return delay + later, LATENCY[1] * (latency / _LATENCY) + older

"""The servos' motors on one battery: firmware, body and supply stepped together."""

from __future__ import annotations

from typing import NamedTuple

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.dynamixel.protocol.codec import FRAME_BITS
from servoid.hw.robot.description import Robot
from servoid.sim.model import TIMESTEP
from servoid.sim.rig.servo.firmware import Firmware
from servoid.sim.rig.servo.plant import Plant

STEP_NS = round(TIMESTEP * 1e9)


class MotorSample(NamedTuple):
    """What a servo's firmware knows of its motor. Angles rad, speeds rad/s, current A, temperature degrees C."""

    angle: float
    speed: float
    current: float
    duty: float
    reference: float
    reference_speed: float
    underway: bool
    temperature: float


class MotorBank:
    """Servo-side quantities `(n_joints,)` in the robot's order, angles from the centre tick as the encoder counts."""

    def __init__(self, robot: Robot, plant: Plant) -> None:
        self.robot, self.plant = robot, plant
        self._direction = np.array([joint.direction for joint in robot.joints], float)
        self._ratio = self._direction * robot.gears  # turns of the servo for one of the joint
        self._zero = np.array([joint.zero for joint in robot.joints])
        if len(set(volts := [servo.voltage for servo in robot.servos])) > 1:
            raise ConfigError(
                f"{robot.name}: its servos are for {min(volts):g} to {max(volts):g} V, and a virtual rig has one supply"
            )
        self.reset()

    def reset(self) -> None:
        """New motors, cold, for a plant that was just reset."""
        plant = self.plant
        first, servos = self.robot.servos[0], self.robot.servos
        wanted = plant.body.command_delay + np.array([servo.command_delay - first.command_delay for servo in servos])
        steps = np.ceil(wanted / TIMESTEP - 1e-6)  # as in simulation, goals act from whole steps on
        delay = np.maximum(steps * TIMESTEP - _cycle(self.robot), 0.0)
        self.firmware = Firmware(self.robot.bare_servos, plant.constant / self.robot.gears, plant.resistance, delay)
        self.firmware.set_stiffness(plant.stiffness)
        self.open_circuit = plant.body.voltage  # V of the battery at rest with the servos idle
        self.sag = 0.0  # V below that: a fault
        self.supply = self.open_circuit
        self.steps = 0  # samples taken
        self.sense()

    def angle_of(self, joint: Array) -> Array:
        """Servo angles of joint angles, both rad."""
        return self._ratio * (joint - self._zero)

    def joint_of(self, angle: Array) -> Array:
        """Joint angles of servo angles, both rad."""
        return angle / self._ratio + self._zero

    def step(self, now_ns: int) -> None:
        """Advance by one physics step, which begins at `now_ns`."""
        plant, firmware = self.plant, self.firmware
        angle, speed = self.angle_of(plant.joints), self._ratio * plant.joint_speed
        volts = firmware.step(now_ns, angle, speed, self.supply)
        plant.step(self._direction * volts, firmware.powered, self.supply)
        draw = firmware.settle(plant.torque / self._ratio, self._ratio * plant.joint_speed, self.supply)
        self.supply = max(self.open_circuit - self.sag - self.robot.bus.supply_resistance * float(draw.sum()), 0.0)
        self.sense()

    def sense(self) -> None:
        """Take what the servos can know by now. Call it after the body was moved by hand."""
        self.steps += 1
        angle, speed, torque = self.plant.encoder
        f = self.firmware
        self.angle = self.angle_of(angle)
        columns = (
            self.angle,
            self._ratio * speed,
            torque / self._ratio / f.torque_per_ampere,
            f.duty,
            f.reference,
            f.reference_speed,
            f.reference != f.goal_position,
            f.winding,
        )
        self.samples = [MotorSample(*row) for row in zip(*(column.tolist() for column in columns), strict=True)]


def _cycle(robot: Robot) -> float:
    """Time on the wire of a control cycle [s] until the goals are written: joints, board and some slow registers read.

    A servo's command delay counts from the beginning of the host's tick, as it was identified on robots; what the bus
    takes of it is not taken a second time inside the servo.
    """
    n = len(robot.joints)
    joints = 14 + n + 8 + 14 * n  # 10 bytes of each in a fast read
    board = 14 + 11 + 20
    slow = 14 + 4 + 4 * (11 + 7)
    goals = 14 + 5 * n
    return (joints + board + slow + goals) * FRAME_BITS / robot.bus.baud

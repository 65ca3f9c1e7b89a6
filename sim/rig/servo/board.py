"""The board of the rig: power switch of the servos, IMU, battery voltage, buttons, LEDs and buzzer (OpenCR, ID 200)."""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace

import numpy as np

from servoid.hw.dynamixel.protocol.codec import StatusError
from servoid.hw.dynamixel.protocol.tables import Item, table
from servoid.hw.imu.mounting import Mounting
from servoid.hw.robot.description import Robot
from servoid.sim.rig.servo.device import VirtualDevice
from servoid.sim.rig.servo.motor_bank import MotorBank

FIRMWARE = 17
AXES = "xyz"


class VirtualBoard(VirtualDevice):
    """An OpenCR whose IMU is mounted as the robot's file says, its registers negated where the real one's are."""

    def __init__(
        self,
        motors: MotorBank,
        eeprom: dict[str, int],
        switch: Callable[[bool], None],
        mounting: Mounting | None = None,
    ) -> None:
        """`switch` turns the servos' power on and off."""
        super().__init__(table("opencr"), {"firmware_version": FIRMWARE, **eeprom})
        self._motors, self._switch = motors, switch
        self._mounting = mounting or Mounting()
        self._gyro = self.table.item("gyro_x").scale
        self._acceleration = self.table.item("acceleration_x").scale
        self._angle = self.table.item("roll").scale
        self._voltage = self.table.item("present_input_voltage").scale
        self.imu_dead = False  # reads zero, as the real one does when its chip does not answer
        self.imu_frozen = False
        self.buttons = 0  # bits held down

    def allowed(self, item: Item, value: int) -> StatusError:
        return self.in_range(item, value)

    def changed(self, item: Item, value: int, now_ns: int) -> None:
        if item.name == "dynamixel_power":
            self._switch(bool(value))

    def restarted(self, now_ns: int) -> None:
        self._switch(False)

    def refresh(self, now_ns: int) -> None:
        self.put("button", self.buttons)
        self.put("present_input_voltage", round(self._motors.supply / self._voltage))
        if self.imu_frozen:
            return
        imu = self._motors.plant.imu
        gyro = self._mounting.to_sensor(imu[:3]) / self._gyro
        force = self._mounting.to_sensor(imu[3:]) / self._acceleration
        angles = np.array(_euler(*self._motors.plant.truth.orientation[0])) / self._angle
        alive = 0 if self.imu_dead else 1
        for i, axis in enumerate(AXES):
            self.put(f"gyro_{axis}", alive * round(float(gyro[i])))
            self.put(f"acceleration_{axis}", alive * round(float(force[i])))
        for name, angle in zip(("roll", "pitch", "yaw"), angles, strict=True):
            self.put(name, alive * round(float(angle)))


def _euler(w: float, x: float, y: float, z: float) -> tuple[float, float, float]:
    """Roll, pitch and yaw [rad] of a quaternion."""
    roll = math.atan2(2 * (w * x + y * z), 1 - 2 * (x * x + y * y))
    pitch = math.asin(max(-1.0, min(1.0, 2 * (w * y - z * x))))
    return roll, pitch, math.atan2(2 * (w * z + x * y), 1 - 2 * (y * y + z * z))


def on_the_board(robot: Robot) -> Robot:
    """The robot with its IMU on the bus, mounted as it is: a virtual rig has no other, and lends a robot without a
    board one for its IMU. Without an IMU the robot is as it is."""
    if robot.imu.kind == "none":
        return robot
    return replace(robot, bus=replace(robot.bus, board="opencr"), imu=replace(robot.imu, kind="opencr", port=None))

"""Servo units to joint units and back, for all joints of a robot at once.

joint = direction * (ticks - center) * 2 pi / (ticks_per_turn * gear) + zero. A position is known within a turn of the
servo only, so it is taken to be the one nearest the middle of the joint's range: safe across the 0/4095 seam, and after
turns that the servo counted while it was limp. A joint whose gear makes its range wider than a turn of its servo is
driven in extended position mode, where the servo counts turns: which one it is in is settled by `anchor`, once.
"""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.dynamixel.protocol.tables import ControlTable
from servoid.hw.robot.description import Robot

GAIN_MAX = 16383
EXTENDED_MAX = 1_048_575  # ticks to either side in extended position mode
_TURN = 2.0 * np.pi


class Units:
    """Conversions in the robot's joint order; arrays are `(n_joints,)`."""

    def __init__(self, robot: Robot, tables: Sequence[ControlTable]) -> None:
        servos = robot.servos
        self._names = robot.names
        self._lower, self._upper = robot.lower, robot.upper
        self._direction = np.array([float(joint.direction) for joint in robot.joints])
        self._zero = np.array([joint.zero for joint in robot.joints])
        self._turn = np.array([servo.ticks_per_turn for servo in servos])
        self._center = np.array([servo.center_tick for servo in servos])
        self._tick = robot.tick_angles  # rad of the joint
        self._wrap = _TURN / robot.gears  # rad of the joint for a turn of its servo
        self._middle = (self._lower + self._upper) / 2.0
        self.extended = robot.extended  # (n_joints,) bool
        self._home = robot.home
        self._turns = np.zeros(len(servos))  # ticks of whole turns that a servo counts beyond the file's
        self._velocity = self._direction * [servo.velocity_unit for servo in servos]
        self._voltage = np.array([servo.voltage_unit for servo in servos])
        self._gain = np.array([servo.position_p_gain for servo in servos])
        # A load in per cent and the current of the supply say nothing about torque: such a joint's effort is NaN.
        self._effort = self._direction * [
            servo.current_unit * servo.torque_per_ampere if table.motor_current else np.nan
            for servo, table in zip(servos, tables, strict=True)
        ]

    def anchor(self, ticks: Sequence[int]) -> None:
        """Settle which turn a servo in extended position mode is in, of what it counts now: the joint is taken to be
        within half a turn of its servo of its home pose. A servo forgets turns without power."""
        angle = self._direction * (np.array(ticks) - self._center) * self._tick + self._zero
        turns = self._direction * np.round((angle - self._home) / self._wrap)
        self._turns = np.where(self.extended, turns * self._turn, 0.0)

    def position(self, ticks: Array) -> Array:
        """Joint angles [rad]; NaN stays NaN."""
        angle = self._direction * (ticks - self._turns - self._center) * self._tick + self._zero
        wrapped = angle - self._wrap * np.round((angle - self._middle) / self._wrap)
        return np.where(self.extended, angle, wrapped)

    def within_turn(self, ticks: Array) -> Array:
        """Ticks as the servo counts them once torque is on: whole turns forgotten, but in extended position mode."""
        return np.where(self.extended, ticks, ticks % self._turn)

    def goal(self, position: Array) -> Array:
        """Goal ticks (int) of joint angles [rad]. Raises ValueError naming a joint whose angle is not finite."""
        if not np.isfinite(position).all():
            joint = self._names[int(np.flatnonzero(~np.isfinite(position))[0])]
            raise ValueError(f"the goal of {joint} is not finite")
        ticks = np.round(self._center + self._direction * (position - self._zero) / self._tick) + self._turns
        lowest = np.where(self.extended, -EXTENDED_MAX, 0)
        return np.clip(ticks, lowest, np.where(self.extended, EXTENDED_MAX, self._turn - 1)).astype(int)

    def limits(self) -> tuple[Array, Array]:
        """Lowest and highest goal ticks (int) of each joint's range, before clipping to a turn."""
        ends = [self._center + self._direction * (end - self._zero) / self._tick for end in (self._lower, self._upper)]
        return np.floor(np.minimum(*ends)).astype(int), np.ceil(np.maximum(*ends)).astype(int)

    def across_the_seam(self) -> list[str]:
        """Joints in position mode whose range does not fit the servo's single turn: they cannot reach all of it."""
        low, high = self.limits()
        bad = ((low < 0) | (high > self._turn - 1)) & ~self.extended
        return [name for name, outside in zip(self._names, bad, strict=True) if outside]

    def velocity(self, raw: Array) -> Array:
        """rad/s."""
        return raw * self._velocity

    def effort(self, raw: Array) -> Array:
        """N m from current where it is the motor's; NaN elsewhere."""
        return raw * self._effort

    def voltage(self, raw: Array) -> Array:
        """V."""
        return raw * self._voltage

    def gain(self, scale: Array) -> Array:
        """Position P gain (int) of gain scales."""
        return np.clip(np.round(self._gain * scale), 0, GAIN_MAX).astype(int)

"""Friction of gears that varies as they turn: Coulomb's, Stribeck's rise of it towards rest, a share of the load."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot


class Friction:
    """The friction of a robot's joints. Where it never `varies`, it is what the model was compiled with."""

    def __init__(self, robot: Robot) -> None:
        servos = robot.servos
        self._coulomb = np.array([servo.friction for servo in servos])
        self._stribeck = np.array([servo.stribeck_friction for servo in servos])
        self._speed = np.array([servo.stribeck_speed for servo in servos])
        self._load = np.array([servo.load_friction for servo in servos])
        self.varies = bool((self._stribeck > 0).any() or (self._load > 0).any())

    def at(self, speed: Array, torque: Array) -> Array:
        """Friction [N m] of joints that turn at `speed` [rad/s] under their motors' `torque` [N m], `(..., n)`."""
        return friction(self._coulomb, self._stribeck, self._speed, self._load, speed, torque)


def friction(coulomb: Array, stribeck: Array, fades: Array, load: Array, speed: Array, torque: Array) -> Array:
    """F = Fc + Fs exp(-(v / vs)^2) + c |motor torque|: the models M1 to M4 of BAM (Duclusaud et al., 2024), with the
    motor's torque in place of what the gears carry, since that is what a simulation knows."""
    result: Array = coulomb + stribeck * np.exp(-np.square(speed / fades)) + load * np.abs(torque)
    return result

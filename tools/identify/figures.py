"""The figures of servos that a recording is fitted by, and how a servo is made of them."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, replace
from typing import Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot, Servo, geared

# Models of friction after BAM (Duclusaud et al., 2024): Coulomb's with damping, with Stribeck's rise, with the load.
MODELS: dict[str, tuple[str, ...]] = {
    "coulomb": (),
    "stribeck": ("stribeck_friction", "stribeck_speed"),
    "load": ("load_friction",),
    "stribeck and load": ("stribeck_friction", "stribeck_speed", "load_friction"),
}
SUPPLY = "supply_resistance"
UNITS = {
    "stiffness": "N m/rad",
    "slope": "N m s/rad",
    "friction": "N m",
    "armature": "kg m2",
    "stall_torque": "N m",
    "command_delay": "s",
    "stribeck_friction": "N m",
    "stribeck_speed": "rad/s",
    "load_friction": "",
    SUPPLY: "Ohm",
}
# How far a figure may be from its file's before anything is measured: a standard deviation, of its logarithm or [s].
_PRIOR = {
    "stiffness": 0.7,
    "slope": 0.4,
    "friction": 0.8,
    "armature": 0.8,
    "stall_torque": 0.2,
    "command_delay": 0.012,
    "stribeck_friction": 1.0,
    "stribeck_speed": 0.7,
    "load_friction": 1.0,
    SUPPLY: 0.8,
}
_BASIC = ("stiffness", "slope", "friction", "armature", "stall_torque", "command_delay")
_LEAST_FRICTION, _LEAST_ARMATURE = 0.005, 1e-5  # of the stall torque; kg m2: where a file says none
_STRIBECK, _FADES, _LOAD, _OHMS = 0.3, 0.15, 0.1, 0.04  # of the friction; rad/s; of the torque; where a file says none


@dataclass(frozen=True)
class ServoFigure:
    """One number that is fitted: `servo` is its servo's name, empty for the supply."""

    servo: str
    name: str
    start: float

    @property
    def spread(self) -> float:
        """Standard deviation before anything is measured: of the logarithm, or of a delay itself [s]."""
        return _PRIOR[self.name]

    def value(self, x: float) -> float:
        """The figure that many standard deviations from where it starts."""
        if self.name == "command_delay":
            return max(self.start + self.spread * x, 0.0)
        return float(self.start * np.exp(self.spread * x))

    def relative(self, deviation: float, value: float) -> float:
        """A standard deviation in units of `spread`, as a share of the figure."""
        return self.spread * deviation / (max(value, 1e-6) if self.name == "command_delay" else 1.0)


class Figures:
    """All that is fitted at once: of each model of servo that moved, and of the supply. A point is `(n,)`, 0 being what
    the files say and 1 a standard deviation from there."""

    def __init__(self, robot: Robot, moved: Sequence[str], model: str) -> None:
        self.robot, self.model = robot, model
        self.servos: dict[str, Servo] = {}
        for joint, servo in zip(robot.joints, robot.bare_servos, strict=True):
            if joint.name in moved:
                self.servos[servo.name] = servo
        self.all = [
            ServoFigure(servo.name, name, start)
            for servo in self.servos.values()
            for name, start in _starts(servo, MODELS[model]).items()
        ] + [ServoFigure("", SUPPLY, robot.bus.supply_resistance or _OHMS)]

    def values(self, point: Array) -> dict[tuple[str, str], float]:
        """Every figure at a point, by servo and name."""
        return {(f.servo, f.name): f.value(float(x)) for f, x in zip(self.all, point, strict=True)}

    def point(self, values: Mapping[tuple[str, str], float]) -> Array:
        """The point of figures, those that are not there being as in the files."""
        result = np.zeros(len(self.all))
        for i, figure in enumerate(self.all):
            if (value := values.get((figure.servo, figure.name))) is None:
                continue
            if figure.name == "command_delay":
                result[i] = (value - figure.start) / figure.spread
            else:
                result[i] = np.log(value / figure.start) / figure.spread
        return result

    def identified(self, point: Array) -> dict[str, Servo]:
        """Each servo that moved as it is at a point, by itself."""
        values = self.values(point)
        return {
            name: _servo(servo, {key: value for (of, key), value in values.items() if of == name})
            for name, servo in self.servos.items()
        }

    def of_joints(self, point: Array) -> tuple[tuple[Servo, ...], float]:
        """The servo of each joint behind its gear, and the supply's resistance [Ohm], at a point."""
        found = self.identified(point)
        pairs = zip(self.robot.joints, self.robot.bare_servos, strict=True)
        servos = tuple(geared(found.get(servo.name, servo), joint.gear) for joint, servo in pairs)
        return servos, self.values(point)["", SUPPLY]


def slope(servo: Servo) -> float:
    """What a servo's torque loses with speed, by its back-EMF and its damping together [N m s/rad]: no motion under
    voltage tells the two apart."""
    return servo.stall_torque / servo.no_load_speed + servo.damping


def _starts(servo: Servo, more: Sequence[str]) -> dict[str, float]:
    friction = max(servo.friction, _LEAST_FRICTION * servo.stall_torque)
    starts = {
        "stiffness": servo.stiffness,
        "slope": slope(servo),
        "friction": friction,
        "armature": max(servo.armature, _LEAST_ARMATURE),
        "stall_torque": servo.stall_torque,
        "command_delay": servo.command_delay,
    }
    extra = {
        "stribeck_friction": servo.stribeck_friction or _STRIBECK * friction,
        "stribeck_speed": servo.stribeck_speed if servo.stribeck_friction else _FADES,
        "load_friction": servo.load_friction or _LOAD,
    }
    return starts | {name: extra[name] for name in more}


def _servo(servo: Servo, values: Mapping[str, float]) -> Servo:
    """The servo with what was fitted. Of the slope, damping is as in the file, or half where that leaves nothing."""
    stall = values["stall_torque"]
    damping = min(servo.damping, values["slope"] / 2)
    plain: dict[str, Any] = {"stribeck_friction": 0.0, "load_friction": 0.0}  # of a simpler model
    kept: dict[str, Any] = {name: value for name, value in values.items() if name not in ("slope", "stall_torque")}
    return replace(
        servo,
        **(plain | kept),
        stall_torque=stall,
        no_load_speed=stall / (values["slope"] - damping),
        damping=damping,
        braking_torque=servo.braking_torque * stall / servo.stall_torque,
    )

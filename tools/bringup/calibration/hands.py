"""Who moves the joints while a robot is calibrated: a person who is told, or a virtual rig's control socket."""

from __future__ import annotations

import math
from collections.abc import Mapping
from typing import Protocol

from servoid.hw.robot.description import Robot
from servoid.sim.rig.process.control import Control
from servoid.tools.bringup.desk.terminal import Desk
from servoid.tools.common.output import Report

TURN = 0.35  # rad that the virtual rig's hands turn a joint by


class Hands(Protocol):
    """Moves joints of a robot without torque."""

    def pose(self, angles: Mapping[str, float], text: str) -> None:
        """Put the robot into a pose [rad] and return when it is there."""
        ...

    def turn(self, joint: str, sign: int, text: str) -> None:
        """Ask for a joint to be turned; returns at once."""
        ...

    def back(self, joint: str) -> None:
        """Ask for it to be put back, more or less."""
        ...


class Person:
    """Reads what to do, and does it. Turning is seen by itself, as both hands are on the robot."""

    def __init__(self, desk: Desk) -> None:
        self._desk, self._report = desk, desk.report

    def pose(self, angles: Mapping[str, float], text: str) -> None:
        if any(angles.values()):
            rows = [(name, f"{angle:+.3f}", f"{math.degrees(angle):+.0f}") for name, angle in angles.items()]
            self._report.table(("joint", "rad", "degrees"), rows)
        self._desk.confirm(text, "calibrate at a terminal, with the robot in your hands")

    def turn(self, joint: str, sign: int, text: str) -> None:
        self._report.line(text)

    def back(self, joint: str) -> None:
        self._report.line("      seen: put it back")


class VirtualHands:
    """Moves the joints of a virtual rig, which is held above its floor. Raises BackendError where it is not."""

    def __init__(self, control: Control, robot: Robot, report: Report) -> None:
        self._control, self._report = control, report
        self._at = dict.fromkeys(robot.names, 0.0)
        report.line("a virtual rig: its joints are moved over its control socket, as a person would by hand")

    def pose(self, angles: Mapping[str, float], text: str) -> None:
        self._report.line(text)
        self._at = dict(angles)
        self._control.move(self._at)

    def turn(self, joint: str, sign: int, text: str) -> None:
        self._report.line(text)
        self._control.move({joint: self._at[joint] + sign * TURN})

    def back(self, joint: str) -> None:
        self._control.move({joint: self._at[joint]})

"""Motions as they were recorded: what a hanging robot was told, and what its encoders said."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, replace
from pathlib import Path

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Payload, Robot
from servoid.stack.log.flightlog import FlightLog, read_log

PIECE, END = "piece", "end"  # kind of the events that a motion begins with, and the text of the one it ends with
_SHORTEST = 1.0  # s of a motion that was cut off
_GRAVITY = 9.81  # m/s2


@dataclass(frozen=True)
class Piece:
    """A motion, `(ticks, n_joints)` each: goals and measured angles [rad], NaN where none came, and gain factors.

    It begins at rest. `gravity` `(3,)` m/s2 is in the base's frame, `voltage` that of the supply as the servos idle.
    """

    name: str
    goal: Array
    measured: Array
    gain: Array
    gravity: Array
    voltage: Array  # (n_joints,) V
    robot: Robot  # as the log has it: with what was hung on it

    @property
    def title(self) -> str:
        """The motion and the gain that it was done at."""
        return f"{self.name}, gain {float(np.median(self.gain)):g}{', loaded' if self.robot.loads else ''}"


def read_pieces(paths: Sequence[Path], robot: Robot) -> list[Piece]:
    """The motions of some logs, whole or cut short. Raises ConfigError for what is no recording of this robot."""
    pieces = [piece for path in paths for piece in _pieces(read_log(path), robot)]
    if not pieces:
        names = ", ".join(str(path) for path in paths)
        raise ConfigError(f"{names}: no motion was recorded to its end: record again with servoid identify")
    return pieces


def _pieces(log: FlightLog, robot: Robot) -> list[Piece]:
    if log.header["settings"]["task"] != "identify":
        raise ConfigError(
            f"{log.path}: a log of {log.header['settings']['task']}: servoid identify records what it needs"
        )
    names = tuple(joint["name"] for joint in log.header["robot"]["joints"])
    if names != robot.names:
        raise ConfigError(
            f"{log.path}: recorded on {log.header['robot']['name']}, whose joints differ from {robot.name}'s"
        )
    marks = [(m["tick"], m["text"]) for m in log.messages["/event"] if m["kind"] == PIECE]
    ticks = log.ticks("/observation")
    if not marks or not len(ticks):
        return []
    hung = log.header["robot"].get("loads", {})
    loads = {body: Payload(load["mass"], tuple(load["at"])) for body, load in hung.items()}
    held = replace(robot, loads=loads)
    position, goal = log.column("/observation", "position"), log.column("/command", "position")
    gain = log.column("/command", "gain")
    before = ticks < marks[0][0]
    force = log.column("/observation", "specific_force")[before]
    force = force[np.isfinite(force).all(-1)]
    pull = -force.mean(0) if len(force) else np.array([0.0, 0.0, -1.0])
    gravity = _GRAVITY * pull / np.linalg.norm(pull)
    volts = log.column("/observation", "voltage")[before]
    read = volts[np.isfinite(volts)]
    nominal = np.array([servo.voltage for servo in robot.servos])
    voltage = nominal if not len(read) else np.full(len(nominal), float(read.mean()))
    found = []
    ends = [*marks[1:], (int(ticks[-1]) + 1, END)]
    for (first, name), (last, _) in zip(marks, ends, strict=True):
        span = np.arange(first, min(last, int(ticks[-1]) + 1))
        if name == END or len(span) < _SHORTEST * robot.rate:
            continue
        row = np.searchsorted(ticks, span, side="right") - 1  # a goal holds through a tick that was missed
        there = ticks[row] == span
        measured = np.where(there[:, None], position[row], np.nan)
        if not np.isfinite(measured[0]).all():
            continue  # where it begins is not known
        found.append(Piece(name, goal[row], measured, gain[row], gravity, voltage, held))
    return found

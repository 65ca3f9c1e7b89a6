"""What was measured of one assembled rig: how each servo sits in its joint. Kept for the user, never in the repository.

A robot's file describes a design. Where a horn sits on its spline and which way round a servo was mounted belong to one
rig: `servoid bringup calibrate` measures them, and everything that drives hardware replaces `zero` and `direction` of
the robot's file by them.
"""

from __future__ import annotations

import errno
import math
import os
from dataclasses import asdict, dataclass, replace
from datetime import datetime
from pathlib import Path
from urllib.parse import quote

import yaml

from servoid.hw.config import ConfigError, load_marked, nearest
from servoid.hw.dynamixel.protocol.tables import table
from servoid.hw.dynamixel.protocol.units import Units
from servoid.hw.robot.description import Robot
from servoid.hw.user_folders import user_folder


@dataclass(frozen=True)
class JointCalibration:
    """A joint as measured: joint angle = direction * servo angle + zero [rad]. `id` and `servo` say of which servo."""

    id: int
    servo: str
    direction: int
    zero: float

    def __post_init__(self) -> None:
        if self.direction not in (1, -1):
            raise ValueError(f"direction must be 1 or -1, not {self.direction}")
        if abs(self.zero) > math.pi:
            raise ValueError(f"zero {self.zero:g} is more than half a turn: it is in radians")


@dataclass(frozen=True)
class Calibration:
    """All joints of a rig. `date` is ISO 8601, `pose` the pose that it was put in to be measured."""

    robot: str
    date: str
    pose: str
    joints: dict[str, JointCalibration]


def calibration_path(robot: Robot) -> Path:
    """Where the calibration of a robot of this name is kept: in $XDG_CONFIG_HOME, or ~/.config, under servoid/.

    Raises ConfigError for a user who has neither.
    """
    folder = user_folder("XDG_CONFIG_HOME", ".config")
    if folder is None:
        raise ConfigError("no home folder: set XDG_CONFIG_HOME to a folder for your calibrations")
    return folder / "calibration" / f"{quote(robot.name, safe='')}.yaml"


def load_calibration(path: Path) -> Calibration:
    """Raises ConfigError naming file, line and key."""
    return load_marked(path, Calibration)[0]


def save_calibration(calibration: Calibration, path: Path) -> Path | None:
    """Write `path`, whole or not at all. An earlier one is kept beside it, and its new name returned.

    Raises ConfigError when the folder cannot be written.
    """
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        earlier = None
        if path.exists():
            earlier = _free(path.with_name(f"{path.stem}-until-{datetime.now():%Y%m%d-%H%M%S}.yaml"))
            _write(earlier, path.read_bytes())  # a copy, so that there is a calibration at every instant
        _write(path, as_text(calibration).encode())
    except OSError as error:
        raise _cannot_write(path, error) from error
    return earlier


def check_writable(path: Path) -> None:
    """Do what `save_calibration` does, with a file beside `path` that is deleted again: twenty joints shall not be
    measured for nothing. Raises ConfigError."""
    try:
        path.parent.mkdir(parents=True, exist_ok=True)
        if path.is_dir():
            raise IsADirectoryError(errno.EISDIR, "it is a folder")
        if path.exists():
            path.read_bytes()
        trial = path.with_name(f"{path.name}.trial")
        _write(trial, b"")
        trial.unlink()
    except OSError as error:
        raise _cannot_write(path, error) from error


def as_text(calibration: Calibration) -> str:
    """The calibration as its file has it."""
    return str(yaml.safe_dump(asdict(calibration), sort_keys=False, default_flow_style=None))


def _write(path: Path, data: bytes) -> None:
    """A file, whole or not at all, and on the disk."""
    partial = path.with_name(path.name + ".partial")
    with partial.open("wb") as file:
        file.write(data)
        file.flush()
        os.fsync(file.fileno())
    os.replace(partial, path)


def _cannot_write(path: Path, error: OSError) -> ConfigError:
    return ConfigError(
        f"{path}: cannot be written: {error.strerror}: set XDG_CONFIG_HOME to your own folder, or use --out FILE"
    )


def apply(robot: Robot, calibration: Calibration, source: str = "the calibration") -> Robot:
    """The robot as it was assembled. Raises ConfigError, naming the joint, for a calibration that is not of it."""
    remedy = "calibrate it anew: servoid bringup calibrate"
    if unknown := [name for name in calibration.joints if name not in robot.names]:
        raise ConfigError(f"{source}: {robot.name} has no joint '{unknown[0]}'; {nearest(unknown[0], robot.names)}")
    joints = []
    for joint, servo in zip(robot.joints, robot.servos, strict=True):
        measured = calibration.joints.get(joint.name)
        if measured is None:
            raise ConfigError(f"{source}: nothing about {joint.name}: {remedy} --joint {joint.name}")
        if (measured.id, measured.servo) != (joint.id, servo.name):
            raise ConfigError(
                f"{source}: {joint.name} was {measured.servo} with ID {measured.id} then, and is {servo.name} with "
                f"ID {joint.id} in the robot's file now: {remedy} --joint {joint.name}"
            )
        joints.append(replace(joint, direction=measured.direction, zero=measured.zero))
    assembled = replace(robot, joints=tuple(joints))
    if seam := across_the_seam(assembled):
        last = robot.servos[robot.names.index(seam[0])].ticks_per_turn - 1
        raise ConfigError(
            f"{source}: with the zero of {', '.join(seam)} a part of the joint's range lies beyond the servo's "
            f"0/{last} seam, which it cannot cross in position mode: take the horn off, "
            f"turn it by half a turn, and {remedy}"
        )
    return assembled


def across_the_seam(robot: Robot) -> list[str]:
    """Joints whose range does not fit the single turn that a servo has in position mode."""
    return Units(robot, [table(servo.model_number) for servo in robot.servos]).across_the_seam()


def calibrated(robot: Robot) -> tuple[Robot, str]:
    """The robot as the user's calibration says that it was assembled, and a line for the person who drives it.

    Without a calibration it is that of its file. Raises ConfigError for a calibration that cannot be used.
    """
    try:
        path = calibration_path(robot)
    except ConfigError as error:
        return robot, f"not calibrated: zero and direction are those of the robot's file ({error})"
    try:
        there = path.exists()
    except OSError as error:
        raise ConfigError(
            f"{path}: cannot be read ({error.strerror}), so it is unknown whether the robot is calibrated"
        ) from error
    if not there:
        return robot, f"not calibrated: zero and direction are those of the robot's file (there is no {path})"
    calibration = load_calibration(path)
    return apply(robot, calibration, str(path)), f"calibrated on {calibration.date[:10]}: {path}"


def _free(path: Path) -> Path:
    """`path`, numbered if there is such a file."""
    names = (path.with_stem(f"{path.stem}{end}") for end in ("", *(f"-{i}" for i in range(2, 1000))))
    return next(name for name in names if not name.exists())

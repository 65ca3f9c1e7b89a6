"""BVH files: a hierarchy of joints with their offsets, then the channels of all joints, a line a frame."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, field
from pathlib import Path

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.tools.motions.human.key_points import SIDES, CapturedMotion

# Names that skeletons give to a point, without spaces, case and prefix: CMU's, Daz's, Mixamo's and Blender's.
_CENTRE = {"hips": ("hip", "hips", "pelvis", "root"), "neck": ("neck", "lowerneck", "neck1", "spine3", "thorax")}
_SIDED = {
    "hip": ("thigh", "femur", "upleg", "upperleg"),
    "knee": ("shin", "tibia", "leg", "lowerleg", "calf"),
    "ankle": ("foot", "ankle"),
    "shoulder": ("shldr", "humerus", "arm", "upperarm"),
    "elbow": ("forearm", "radius", "lowerarm"),
    "hand": ("hand", "wrist"),
}
_AXES = "XYZ"
_LEADING, _JUMP = 10, 2.0  # frames that may be the rest pose's; how much faster than the rest a jump is
_ALONG = 0.8  # of its length, that a body in its rest pose is along the axis that is up


@dataclass
class _Joint:
    name: str
    parent: int
    offset: Array = field(default_factory=lambda: np.zeros(3))
    channels: list[str] = field(default_factory=list)
    end: Array | None = None  # of its End Site


def read_bvh(path: Path, text: str) -> CapturedMotion:
    """Key points of a BVH file, z up, whichever of y and z is up there. Raises ConfigError naming what is wrong."""
    head, found, motion = text.partition("MOTION")
    if "HIERARCHY" not in head or not found:
        raise ConfigError(f"{path}: not a BVH file, or cut off: HIERARCHY and MOTION are missing")
    joints = _hierarchy(path, head)
    rate, frames = _frames(path, motion, sum(len(joint.channels) for joint in joints))
    which = _points(path, joints)
    turn = _upright(path, joints, which)
    places = _places(joints, frames)
    points = {name: places[key] @ turn.T for name, key in which.items()}
    return _without_rest_pose(CapturedMotion(rate, points))


def _hierarchy(path: Path, text: str) -> list[_Joint]:
    joints: list[_Joint] = []
    stack: list[int] = []
    ending = False
    words = iter(text.split())
    for word in words:
        if word in ("ROOT", "JOINT"):
            joints.append(_Joint(next(words, ""), stack[-1] if stack else -1))
        elif word == "End":
            ending = True
        elif word == "{":
            stack.append(len(joints) - 1 if not ending else -2)
        elif word == "}":
            ending = False
            if stack:
                stack.pop()
        elif word == "OFFSET":
            offset = np.array(_numbers(path, words, 3))
            if ending:
                joints[-1].end = offset
            else:
                joints[-1].offset = offset
        elif word == "CHANNELS":
            joints[-1].channels = [next(words, "") for _ in range(int(_numbers(path, words, 1)[0]))]
    if not joints:
        raise ConfigError(f"{path}: its hierarchy holds no joint")
    if not any(channel.endswith("rotation") for joint in joints[1:] for channel in joint.channels):
        raise ConfigError(f"{path}: has no rotation channels: export it with rotations, not with positions alone")
    for joint in joints:
        for channel in joint.channels:
            if channel[:1] not in _AXES or channel[1:] not in ("position", "rotation"):
                raise ConfigError(f"{path}: joint {joint.name}: unknown channel '{channel}'")
    return joints


def _numbers(path: Path, words: Iterator[str], n: int) -> list[float]:
    try:
        return [float(next(words)) for _ in range(n)]
    except (ValueError, StopIteration):
        raise ConfigError(f"{path}: its hierarchy is damaged or cut off: a number is missing") from None


def _frames(path: Path, text: str, channels: int) -> tuple[float, Array]:
    lines = [line for line in text.splitlines() if line.strip()]
    try:
        count, dt = (int(lines[0].split(":")[1]), float(lines[1].split(":")[1]))
    except (IndexError, ValueError):
        raise ConfigError(f"{path}: 'Frames:' and 'Frame Time:' are missing after MOTION") from None
    if not dt > 0.0:
        raise ConfigError(f"{path}: Frame Time: {dt:g}: must be above 0")
    if len(lines) - 2 < count:
        raise ConfigError(f"{path}: cut off: it says {count} frames, but holds {len(lines) - 2}")
    rows = [line.split() for line in lines[2 : 2 + count]]
    for number, row in enumerate(rows, 1):
        if len(row) != channels:
            raise ConfigError(
                f"{path}: frame {number} has {len(row)} numbers instead of {channels}: cut off or damaged"
            )
    try:
        frames = np.array(rows, dtype=float).reshape(count, channels)
    except ValueError as error:
        raise ConfigError(f"{path}: {error}") from None
    if not np.isfinite(frames).all() or count < 2:
        raise ConfigError(f"{path}: holds {count} frames; at least 2 are needed, of finite numbers")
    return 1.0 / dt, frames


def _points(path: Path, joints: list[_Joint]) -> dict[str, tuple[int, bool]]:
    """Which joint, or the end of which, is at each point."""
    plain = [joint.name.split(":")[-1].replace("_", "").replace(".", "").replace(" ", "").lower() for joint in joints]
    wanted = {name: aliases for name, aliases in _CENTRE.items()}
    for side in SIDES:
        for part, aliases in _SIDED.items():
            wanted[f"{side}_{part}"] = tuple(f"{mark}{alias}" for alias in aliases for mark in (side[0], side))
            wanted[f"{side}_{part}"] += tuple(f"{alias}{mark}" for alias in aliases for mark in (side[0], side))
    found = {}
    for name, aliases in wanted.items():
        index = next((plain.index(alias) for alias in aliases if alias in plain), None)
        if index is None:
            known = ", ".join(joint.name for joint in joints)
            raise ConfigError(f"{path}: no joint for '{name.replace('_', ' ')}'; it has {known}")
        found[name] = (index, False)
    for side in SIDES:
        ankle = found[f"{side}_ankle"][0]
        toe = next((i for i, joint in enumerate(joints) if joint.parent == ankle), None)
        found[f"{side}_toe"] = (ankle, True) if toe is None else (toe, False)
    return found


def _upright(path: Path, joints: list[_Joint], which: dict[str, tuple[int, bool]]) -> Array:
    """The turn `(3, 3)` that makes z up, by the rest pose. Raises ConfigError where it lies, or leans."""
    rest = _places(joints, np.zeros((1, sum(len(joint.channels) for joint in joints))))
    feet = (rest[which["left_ankle"]][0] + rest[which["right_ankle"]][0]) / 2
    body = rest[which["neck"]][0] - feet
    axis = int(np.abs(body).argmax())
    if axis == 0 or body[axis] < _ALONG * np.linalg.norm(body):
        raise ConfigError(
            f"{path}: its rest pose does not stand along y or z, so which axis is up is not known: "
            f"the neck is at {np.round(body, 1).tolist()} from the feet"
        )
    return np.array([[0.0, 0.0, 1.0], [1.0, 0.0, 0.0], [0.0, 1.0, 0.0]]) if axis == 1 else np.eye(3)


def _places(joints: list[_Joint], frames: Array) -> dict[tuple[int, bool], Array]:
    """Places `(ticks, 3)` of the joints, and of the ends of those that have one."""
    places: dict[tuple[int, bool], Array] = {}
    turns: list[Array] = []
    at = 0
    for i, joint in enumerate(joints):
        values = frames[:, at : at + len(joint.channels)]
        at += len(joint.channels)
        offset, turn = np.tile(joint.offset, (len(frames), 1)), np.tile(np.eye(3), (len(frames), 1, 1))
        for channel, value in zip(joint.channels, values.T, strict=True):
            axis = _AXES.index(channel[0])
            if channel.endswith("position"):
                offset[:, axis] = value if i == 0 else joint.offset[axis] + value
            else:
                turn = turn @ _about(axis, np.radians(value))
        if joint.parent >= 0:
            before = turns[joint.parent]
            offset = places[joint.parent, False] + np.einsum("tij,tj->ti", before, offset)
            turn = before @ turn
        places[i, False] = offset
        turns.append(turn)
        end = joint.end if joint.end is not None else np.zeros(3)
        places[i, True] = offset + turn @ end
    return places


def _about(axis: int, angle: Array) -> Array:
    """Rotations `(ticks, 3, 3)` about a coordinate axis."""
    out = np.zeros((len(angle), 3, 3))
    i, j = (axis + 1) % 3, (axis + 2) % 3
    out[:, axis, axis] = 1.0
    out[:, i, i] = out[:, j, j] = np.cos(angle)
    out[:, j, i], out[:, i, j] = np.sin(angle), -np.sin(angle)
    return out


def _without_rest_pose(motion: CapturedMotion) -> CapturedMotion:
    """Without the first frames where they jump: some files begin with their rest pose."""
    step = np.max([np.linalg.norm(np.diff(at, axis=0), axis=-1) for at in motion.points.values()], axis=0)
    if len(step) <= 2 * _LEADING:
        return motion
    jumps = np.flatnonzero(step[:_LEADING] > _JUMP * np.percentile(step[_LEADING:], 95))
    return motion.cut(int(jumps[-1]) + 1, motion.ticks) if jumps.size else motion

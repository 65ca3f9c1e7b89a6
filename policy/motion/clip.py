"""A clip: a short motion of one robot at its own rate, in a file that says what it is and who may use it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, replace
from pathlib import Path
from typing import Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.geometry import headed, multiply, turned, yaw_of
from servoid.hw.robot.description import Robot
from servoid.hw.robot.mirror import Mirror
from servoid.policy import checkpoint

SUFFIX = ".safetensors"
POSES = ("upright", "lying on the front", "lying on the back", "lying", "sitting")


@dataclass(frozen=True)
class About:
    """What a clip is, for people and for whoever chooses one."""

    captions: tuple[str, ...]  # what it shows, in words that may ask for it
    source: str  # where it comes from: a file and a page, or the command that made it
    licence: str
    begins: str = "upright"  # one of POSES
    ends: str = "upright"
    loop: bool = False  # its last frame leads on to its first
    mirror: str = ""  # the clip that shows it with left and right swapped, where there is one

    def __post_init__(self) -> None:
        if not self.captions or not all(text.strip() for text in self.captions):
            raise ValueError("captions: at least one is needed, and none may be empty")
        if not self.licence.strip() or not self.source.strip():
            raise ValueError("source and licence: say where the motion comes from and who may use it")
        for key, pose in (("begins", self.begins), ("ends", self.ends)):
            if pose not in POSES:
                raise ValueError(f"{key}: '{pose}' is none of {', '.join(POSES)}")


@dataclass(frozen=True)
class Clip:
    """`ticks` frames at the robot's rate.

    The root's place is in a frame of the clip's own: the first frame's base is above the origin and faces along x;
    z is up, and zero on the ground.
    """

    name: str
    joints: Array  # (ticks, n_joints) rad
    root_position: Array  # (ticks, 3) m of the base
    root_orientation: Array  # (ticks, 4) quaternion w x y z of the base
    contact: Array  # (ticks, n_feet) 0..1, how much a foot carries
    about: About

    def __post_init__(self) -> None:
        ticks = len(self.joints)
        if ticks < 2:
            raise ValueError(f"a clip of {ticks} frames is no motion: at least 2 are needed")
        for name in ("root_position", "root_orientation", "contact"):
            if len(array := self._arrays()[name]) != ticks:
                raise ValueError(f"{name} has {len(array)} frames, and joints {ticks}")
        if not all(np.isfinite(array).all() for array in self._arrays().values()):
            raise ValueError("a frame is not finite")

    def _arrays(self) -> dict[str, Array]:
        return {
            "joints": self.joints,
            "root_position": self.root_position,
            "root_orientation": self.root_orientation,
            "contact": self.contact,
        }

    @property
    def ticks(self) -> int:
        return len(self.joints)

    def placed(self) -> Clip:
        """The same clip with its first frame above the origin, facing along x."""
        yaw = yaw_of(self.root_orientation[0])
        position = self.root_position - np.append(self.root_position[0, :2], 0.0)
        return replace(self, root_position=turned(position, -yaw), root_orientation=headed(self.root_orientation, -yaw))

    def mirrored(self, robot: Robot, name: str) -> Clip:
        """Left and right swapped, under another name; what its captions say is swapped too."""
        x, y, z = self.root_position.T
        return replace(
            self,
            name=name,
            joints=Mirror.joints(robot)(self.joints),
            root_position=np.stack([x, -y, z], -1),
            root_orientation=self.root_orientation * np.array([1.0, -1.0, 1.0, -1.0]),
            contact=Mirror.feet(robot)(self.contact),
            about=replace(
                self.about, captions=tuple(other_side(text) for text in self.about.captions), mirror=self.name
            ),
        )

    def at_rate(self, factor: float) -> Clip:
        """Played `factor` times as fast: resampled, joints and place linearly, orientation on the shortest arc."""
        ticks = max(round((self.ticks - 1) / factor) + 1, 2)
        return self.sampled(np.linspace(0.0, self.ticks - 1.0, ticks))

    def sampled(self, at: Array) -> Clip:
        """The frames at times `at` [ticks, fractions too], each within the clip."""
        low = np.clip(np.floor(at).astype(int), 0, self.ticks - 2)
        share = (at - low)[:, None]

        def between(values: Array) -> Array:
            return values[low] + share * (values[low + 1] - values[low])

        near = self.root_orientation[low + 1]
        near = near * np.where((near * self.root_orientation[low]).sum(-1, keepdims=True) < 0.0, -1.0, 1.0)
        quaternion = self.root_orientation[low] + share * (near - self.root_orientation[low])
        return replace(
            self,
            joints=between(self.joints),
            root_position=between(self.root_position),
            root_orientation=quaternion / np.linalg.norm(quaternion, axis=-1, keepdims=True),
            contact=between(self.contact),
        )

    def followed_by(self, other: Clip, blend: int, name: str) -> Clip:
        """This clip, then `other` from where this one ends, over `blend` ticks in which one becomes the other.

        Raises ConfigError where a clip is shorter than the blend, or where one lies and the other stands.
        """
        if not 0 < blend < min(self.ticks, other.ticks):
            raise ConfigError(f"a blend of {blend} ticks does not fit clips of {self.ticks} and {other.ticks} ticks")
        if self.about.ends != other.about.begins:
            raise ConfigError(
                f"'{self.name}' ends {self.about.ends} and '{other.name}' begins {other.about.begins}: "
                "no motion between the two is known"
            )
        place, turn = self.root_position[-blend], yaw_of(self.root_orientation[-blend])
        begin = other.placed()
        moved = turned(begin.root_position, turn) + np.append(place[:2], 0.0)
        second = replace(begin, root_position=moved, root_orientation=headed(begin.root_orientation, turn))
        weight = smooth(np.arange(1, blend + 1) / (blend + 1.0))[:, None]
        first_end, second_begin = self.sampled(_last(self, blend)), second.sampled(np.arange(blend, dtype=float))

        def join(a: Array, ends: Array, begins: Array, b: Array) -> Array:
            return np.concatenate([a[:-blend], ends + weight * (begins - ends), b[blend:]])

        near = second_begin.root_orientation
        near = near * np.where((near * first_end.root_orientation).sum(-1, keepdims=True) < 0.0, -1.0, 1.0)
        orientation = join(self.root_orientation, first_end.root_orientation, near, second.root_orientation)
        return Clip(
            name,
            join(self.joints, first_end.joints, second_begin.joints, second.joints),
            join(self.root_position, first_end.root_position, second_begin.root_position, second.root_position),
            orientation / np.linalg.norm(orientation, axis=-1, keepdims=True),
            join(self.contact, first_end.contact, second_begin.contact, second.contact),
            About(
                captions=tuple(f"{a}, then {b}" for a in self.about.captions for b in other.about.captions)[:4],
                source=f"blend of '{self.name}' and '{other.name}': {self.about.source}; {other.about.source}",
                licence=" and ".join(dict.fromkeys((self.about.licence, other.about.licence))),
                begins=self.about.begins,
                ends=other.about.ends,
            ),
        )


def _last(clip: Clip, ticks: int) -> Array:
    return np.arange(clip.ticks - ticks, clip.ticks, dtype=float)


def smooth(share: Array) -> Array:
    """0..1 to 0..1 with no velocity and no acceleration at either end (minimum jerk)."""
    s = np.clip(share, 0.0, 1.0)
    return s**3 * (10.0 - 15.0 * s + 6.0 * s**2)


def other_side(text: str) -> str:
    """A sentence with left and right swapped."""
    words = {"left": "right", "right": "left", "Left": "Right", "Right": "Left"}
    return " ".join(words.get(word, word) for word in text.split(" "))


def velocities(clip: Clip, dt: float) -> tuple[Array, Array, Array]:
    """Rates of change by central differences: joints `(ticks, n_joints)` rad/s, root `(ticks, 3)` m/s and
    `(ticks, 3)` rad/s, both in the clip's frame."""
    joints = np.gradient(clip.joints, dt, axis=0)
    linear = np.gradient(clip.root_position, dt, axis=0)
    q = clip.root_orientation
    conjugate = q * np.array([1.0, -1.0, -1.0, -1.0])
    before, after = np.maximum(np.arange(len(q)) - 1, 0), np.minimum(np.arange(len(q)) + 1, len(q) - 1)
    turn = multiply(q[after], conjugate[before])
    turn = turn * np.where(turn[:, :1] < 0.0, -1.0, 1.0)
    sine = np.linalg.norm(turn[:, 1:], axis=-1, keepdims=True)
    angle = 2.0 * np.arctan2(sine, turn[:, :1])
    angular = turn[:, 1:] * np.where(sine > 1e-9, angle / np.maximum(sine, 1e-9), 2.0)
    return joints, linear, angular / (dt * (after - before))[:, None]


def save(clip: Clip, path: Path, robot: Robot) -> None:
    """Write a clip of `robot`. Raises CheckpointError."""
    head = checkpoint.header(
        "clip",
        robot,
        config={"feet": list(robot.feet)},
        data=clip.about.source,
        licence=clip.about.licence,
        results={},
        name=clip.name,
        about=_plain(asdict(clip.about)),
    )
    checkpoint.write(path, {name: array.astype(np.float32) for name, array in clip._arrays().items()}, head)


def load(path: Path, robot: Robot) -> Clip:
    """Read a clip. Raises CheckpointError where it is none, or of another robot, joint order or rate."""
    head, arrays = checkpoint.read(path)
    checkpoint.check(path, head, "clip", robot)
    if (feet := head["config"].get("feet")) != list(robot.feet):
        raise checkpoint.CheckpointError(f"{path}: its feet are {feet}, those of {robot.name} {list(robot.feet)}")
    return _made(path, head, {name: array.astype(float) for name, array in arrays.items()})


def read_about(path: Path) -> tuple[str, About, dict[str, Any]]:
    """Name of a clip, what it is, and its header, without its frames. Raises CheckpointError."""
    head = checkpoint.read_header(path)
    if head["kind"] != "clip":
        raise checkpoint.CheckpointError(f"{path}: holds a {head['kind']}, not a clip")
    try:
        return str(head["name"]), _about(head["about"]), head
    except (KeyError, TypeError, ValueError) as error:
        raise checkpoint.CheckpointError(f"{path}: not a clip of this program: {error}") from error


def _made(path: Path, head: Mapping[str, Any], arrays: dict[str, Array]) -> Clip:
    try:
        return Clip(name=str(head["name"]), about=_about(head["about"]), **arrays)
    except (KeyError, TypeError, ValueError) as error:
        raise checkpoint.CheckpointError(f"{path}: not a clip of this program: {error}") from error


def _about(values: Mapping[str, Any]) -> About:
    return About(**{**values, "captions": tuple(values["captions"])})


def _plain(values: dict[str, Any]) -> dict[str, Any]:
    return {key: list(value) if isinstance(value, tuple) else value for key, value in values.items()}

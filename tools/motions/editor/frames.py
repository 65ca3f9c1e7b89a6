"""Keyframes under a person's hands: each a whole pose of a robot on its feet, changed a bit at a time."""

from __future__ import annotations

from dataclasses import dataclass, replace

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.geometry import rotate
from servoid.hw.robot.description import Robot
from servoid.hw.robot.mirror import Mirror
from servoid.tools.motions.author import REACHED, Author, KeyPose
from servoid.tools.motions.keyframes import Keyframe
from servoid.tools.motions.standing import matrix

SHORTEST, LONGEST = 0.05, 20.0  # s of a keyframe
AXES = "xyz"
# What sliders change of a pose beside joints: name -> lowest and highest, m and rad.
BASE = {"tilt roll": 0.5, "tilt pitch": 0.8, "tilt yaw": 0.6, "lean forward": 0.03, "lean left": 0.03}
ROOM = {"foot": 0.12, "hand": 0.25}  # m that a foot and a hand may be moved by


@dataclass(frozen=True)
class TimedPose:
    """A keyframe: the pose, the time that the robot takes to get there, and for which it stays [s]."""

    pose: KeyPose
    seconds: float = 1.0
    hold: float = 0.0


class Poser:
    """Changes poses of a robot. Raises ConfigError for legs that poses cannot be solved for."""

    def __init__(self, robot: Robot) -> None:
        self.robot, self.author = robot, Author(robot)
        self.home = self.author.home
        self.hands = tuple(name for name in self.author.standing.statics.geoms if "hand" in name)
        self.feet = tuple(robot.feet)
        legs = set(self.author.standing.legs.index.ravel().tolist())
        self.free = tuple(i for i in range(len(robot.joints)) if i not in legs)  # joints of no leg

    def solved(self, pose: KeyPose) -> tuple[Array, Array, Array]:
        """Joints `(n_joints,)` rad, and place `(3,)` m and quaternion `(4,)` of the base."""
        return self.author.stand(pose)

    def handles(self, pose: KeyPose) -> dict[str, Array]:
        """Where hands and soles are `(3,)` m, on the ground that the robot stands on."""
        joints, place, turn = self.solved(pose)
        standing = self.author.standing
        soles = standing.soles(joints[None], place[None], turn[None])[0]
        found = dict(zip(self.feet, soles, strict=True))
        return found | {hand: place + rotate(turn, standing.statics.place(hand, joints)) for hand in self.hands}

    def with_joint(self, pose: KeyPose, joint: str, angle: float) -> KeyPose:
        i = self.robot.names.index(joint)
        joints = pose.joints.copy()
        margin = self.robot.limits.margin
        joints[i] = np.clip(angle, self.robot.lower[i] + margin, self.robot.upper[i] - margin)
        return replace(pose, joints=joints)

    def with_base(self, pose: KeyPose, what: str, value: float) -> KeyPose:
        """`what` is one of BASE, or height."""
        if what == "height":
            return replace(pose, height=np.array(value))
        part, axis = what.split()
        values = (pose.tilt if part == "tilt" else pose.lean).copy()
        values[("roll", "pitch", "yaw", "forward", "left").index(axis) % 3] = np.clip(value, -BASE[what], BASE[what])
        return replace(pose, tilt=values) if part == "tilt" else replace(pose, lean=values)

    def with_weight(self, pose: KeyPose, share: float) -> KeyPose:
        """`share` of the weight on the first foot; the others carry the rest alike."""
        share, n = float(np.clip(share, 0.0, 1.0)), len(self.feet)
        return replace(pose, weight=np.array([share, *[(1.0 - share) / (n - 1)] * (n - 1)]))

    def with_foot(self, pose: KeyPose, foot: str, place: Array) -> KeyPose:
        """A sole's centre at `place` `(3,)` m of the ground, as near as that is allowed."""
        i = self.feet.index(foot)
        feet = pose.feet.copy()
        room = ROOM["foot"]
        feet[i] = np.clip(self.author.offset(i, place, pose.turn[i, 2]), [-room, -room, 0.0], room)
        return replace(pose, feet=feet)

    def with_hand(self, pose: KeyPose, hand: str, place: Array) -> tuple[KeyPose, float]:
        """A hand at `place` `(3,)` m of the ground, by bending its arm; and by how much it misses, m."""
        joints, base, turn = self.solved(pose)
        back = turn * np.array([1.0, -1.0, -1.0, -1.0])
        reached, missed = self.author.standing.statics.reach(hand, rotate(back, place - base), joints)
        kept = pose.joints.copy()
        kept[list(self.free)] = reached[list(self.free)]
        return replace(pose, joints=kept), missed if missed > REACHED else 0.0

    def mirrored(self, pose: KeyPose) -> KeyPose:
        """Left and right swapped."""
        feet, flip = Mirror.feet(self.robot), np.array([1.0, -1.0, 1.0])
        order = feet.index
        return replace(
            pose,
            tilt=pose.tilt * [-1.0, 1.0, -1.0],
            weight=pose.weight[order],
            lean=pose.lean * flip[:2],
            feet=pose.feet[order] * flip,
            turn=pose.turn[order] * [-1.0, 1.0, -1.0],
            joints=Mirror.joints(self.robot)(pose.joints).astype(float),
        )

    def taken(self, joints: Array, pose: KeyPose, *, arms_alone: bool) -> KeyPose:
        """The pose `(n_joints,)` rad that a limp robot was put into, as one that stands: its feet as they are to each
        other, the base over them as the weight and the lean of `pose` ask."""
        kept = pose.joints.copy()
        kept[list(self.free)] = np.clip(joints, self.robot.lower, self.robot.upper)[list(self.free)]
        if arms_alone:
            return replace(pose, joints=kept)
        legs = self.author.standing.legs
        height, base = legs.stand(joints)
        leg = legs.pick(joints)
        soles = rotate(base, legs.soles(leg)[0]) + np.array([0.0, 0.0, height])
        turn = np.stack([_angles(matrix(base) @ foot) for foot in legs.forward(leg)[1]])
        soles[:, :2] += self.author.middle[:2] - soles[:, :2].mean(0)
        feet = np.stack([self.author.offset(i, sole, turn[i, 2]) for i, sole in enumerate(soles)])
        return replace(pose, height=np.array(height), tilt=_angles(matrix(base)), feet=feet, turn=turn, joints=kept)

    def keyframe(self, frame: TimedPose) -> Keyframe:
        """As `servoid motions author` reads it."""
        pose, names = frame.pose, self.robot.names

        def plain(values: Array) -> tuple[float, ...]:
            return tuple(round(float(value), 5) for value in np.ravel(values))

        shares = [round(float(share), 4) for share in pose.weight]
        shares[-1] = 1.0 - sum(shares[:-1])
        return Keyframe(
            seconds=frame.seconds,
            hold=frame.hold,
            height=round(float(pose.height), 5),
            tilt=plain(pose.tilt),  # type: ignore[arg-type]
            weight=dict(zip(self.feet, shares, strict=True)),
            lean=plain(pose.lean),  # type: ignore[arg-type]
            feet={foot: plain(place) for foot, place in zip(self.feet, pose.feet, strict=True)},  # type: ignore[misc]
            turn={foot: plain(turn) for foot, turn in zip(self.feet, pose.turn, strict=True)},  # type: ignore[misc]
            joints={names[i]: round(float(pose.joints[i]), 5) for i in self.free},
        )


def number(what: str, text: str, low: float, high: float) -> float:
    """A number that somebody filled in. Raises ConfigError."""
    try:
        value = float(text)
    except ValueError:
        value = np.nan
    if not low <= value <= high:
        raise ConfigError(f"{what}: '{text}' is no number from {low:g} to {high:g}")
    return value


def _angles(rotation: Array) -> Array:
    """Roll, pitch and yaw `(3,)` of a rotation `(3, 3)`: what `quaternion` makes of them is it."""
    r = rotation
    return np.array(
        [np.arctan2(r[2, 1], r[2, 2]), np.arctan2(-r[2, 0], np.hypot(r[2, 1], r[2, 2])), np.arctan2(r[1, 0], r[0, 0])]
    )

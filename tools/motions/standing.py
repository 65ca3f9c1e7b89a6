"""Poses of a robot on its feet: the base over given feet, with its centre of mass where it is asked to be."""

from __future__ import annotations

import itertools
from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import rotate
from servoid.hw.robot.description import Robot
from servoid.hw.robot.legs import LegInverse, Legs
from servoid.hw.robot.mirror import Mirror
from servoid.policy.motion.clip import Clip
from servoid.sim.poses.statics import Statics
from servoid.tools.motions.physics import play

_ROUNDS = 60  # of moving the base until the centre of mass is in its place; each leaves about half of the error
_SETTLE_TICKS = 50
_FLIGHT = 25  # ticks without a foot on the ground in which servos are told to be ready for the weight
_TAKING_OVER = 5  # ticks in which a foot takes over the weight from another


@dataclass(frozen=True)
class Stance:
    """What is asked, over `ticks` or one pose (leading dimensions `...`)."""

    height: Array  # (...,) m of the base
    tilt: Array  # (..., 3) roll, pitch, yaw of the base
    centre: Array  # (..., 2) m, of mass
    feet: Array  # (..., n_feet, 3) m, the soles' centres
    turn: Array  # (..., n_feet, 3) roll, pitch, yaw
    joints: Array  # (..., n_joints) rad; those of the legs are solved for


class Standing:
    """Solves stances of a robot. Raises ConfigError for legs of another build than `LegInverse` can bend."""

    def __init__(self, robot: Robot) -> None:
        self.robot, self.legs, self.statics = robot, Legs(robot), Statics(robot)
        self.inverse = LegInverse(self.legs, robot.name)
        self._stiffness = np.array([servo.stiffness for servo in robot.servos])
        self._half = min(foot.half_size[1] for foot in robot.feet.values())
        self._braced = np.zeros(len(robot.joints))
        self.home, self._braced = self._settled()

    def _settled(self) -> tuple[Stance, Array]:
        """The stance of a robot that is told its home pose, and what its goals are there beside what `loaded` says."""
        played = play(np.tile(self.robot.home, (_SETTLE_TICKS, 1)), self.robot).joints[0, -1:]
        joints = (played + Mirror.joints(self.robot)(played)) / 2  # what physics leaves of left and right is chance
        height, turn = self.legs.stand(joints)
        tilt = np.stack([np.zeros(1), 2.0 * np.arctan2(turn[:, 2], turn[:, 0]), np.zeros(1)], -1)
        place, turn = np.stack([np.zeros(1), np.zeros(1), height], -1), quaternion(tilt)
        feet = self.soles(joints, place, turn) * [1.0, 1.0, 0.0]
        home = Stance(height, tilt, self.statics.centre(joints, place, turn), feet, np.zeros_like(feet), joints)
        solved = self.solve(home)
        return home, self.robot.home - self.loaded(*solved, np.ones(feet.shape[:2], bool))[0]

    def solve(self, stance: Stance) -> tuple[Array, Array, Array]:
        """Joints `(ticks, n_joints)`, and place `(ticks, 3)` and quaternion `(ticks, 4)` of the base."""
        turn = quaternion(stance.tilt)
        joints = stance.joints.copy()
        place = np.concatenate([stance.centre, stance.height[:, None]], -1)
        for _ in range(_ROUNDS):
            joints[:, self.legs.index] = self._bent(stance, place, turn)
            error = stance.centre - self.statics.centre(joints, place, turn)
            place[:, :2] += error
            if np.abs(error).max() < 1e-5:
                break
        joints[:, self.legs.index] = self._bent(stance, place, turn)
        return joints, place, turn

    def _bent(self, stance: Stance, place: Array, turn: Array) -> Array:
        back = turn[:, None] * np.array([1.0, -1.0, -1.0, -1.0])
        rotation = matrix(back) @ matrix(quaternion(stance.turn))
        sole = rotate(back, stance.feet - place[:, None])
        ankle = sole - np.einsum("tlij,lj->tli", rotation, self.inverse.sole - self.inverse.ankle)
        return self.inverse(ankle, rotation)

    def miss(self, stance: Stance, joints: Array, place: Array, turn: Array) -> Array:
        """How far each sole is from where it should be `(ticks, n_feet)` m: what is out of the legs' reach."""
        return np.linalg.norm(self.soles(joints, place, turn) - stance.feet, axis=-1)

    def soles(self, joints: Array, place: Array, turn: Array) -> Array:
        """The soles' centres `(ticks, n_feet, 3)` m."""
        centre, _ = self.legs.soles(self.legs.pick(joints))
        return rotate(turn[:, None], centre) + place[:, None]

    def loaded(self, joints: Array, place: Array, turn: Array, carries: Array) -> Array:
        """The goals `(ticks, n_joints)` rad that servos, which give under load, hold still poses by.

        `carries` `(ticks, n_feet)` bool says which feet do, from one to the other over some ticks. Each pushes straight
        up, the centre of pressure being below that of mass, as far as soles reach, and against the others as much as in
        the home pose.
        """
        soles, centre = self.soles(joints, place, turn), self.statics.centre(joints, place, turn)
        weight = _averaged(shares(soles[..., :2], centre, carries))
        off = centre - (weight[..., None] * soles[..., :2]).sum(1)
        off = off * np.minimum(1.0, self._half / np.maximum(np.linalg.norm(off, axis=-1, keepdims=True), 1e-9))
        points = soles + np.concatenate([off, np.zeros((len(off), 1))], -1)[:, None]
        torque = self.statics.torque(joints, place, turn, points, weight)
        both = weight.shape[1] * weight.min(-1, keepdims=True)
        return joints + torque / self._stiffness + both * self._braced

    def held(self, clip: Clip) -> Array:
        """The poses `(ticks, n_joints)` rad that servos hold which are told a clip's goals: what `loaded` undoes."""
        joints, place, turn = clip.joints, clip.root_position, clip.root_orientation
        for _ in range(_ROUNDS):
            step = clip.joints - self.loaded(joints, place, turn, clip.contact > 0.5)
            joints = joints + 0.5 * step
            if np.abs(step).max() < 1e-4:
                break
        return joints


def shares(soles: Array, centre: Array, carries: Array) -> Array:
    """Share of the weight `(ticks, n_feet)` on each foot that carries, by where the centre of mass is between them.

    The shares' mean of the soles' centres is as near to it as shares from 0 to 1 allow; without a foot on the
    ground they are 0.
    """
    n = np.maximum(carries.sum(-1), 1)[:, None]
    middle = (carries[..., None] * soles).sum(1) / n
    arm = np.where(carries[..., None], soles - middle[:, None], 0.0)
    spread = np.maximum((arm * arm).sum((1, 2)), 1e-9)[:, None]
    share = np.einsum("tfi,ti->tf", arm, centre - middle) / spread + 1.0 / n
    share = np.where(carries, np.clip(share, 0.0, 1.0), 0.0)
    return share / np.maximum(share.sum(-1, keepdims=True), 1e-9)


def _averaged(share: Array) -> Array:
    """Over `_TAKING_OVER` ticks; between short flights and the ground there is no change."""
    carried = np.flatnonzero(share.sum(-1) > 0.0)
    for last, first in itertools.pairwise(carried):
        if 1 < first - last <= _FLIGHT:
            way = (np.arange(last + 1, first) - last)[:, None] / (first - last)
            share[last + 1 : first] = share[last] + way * (share[first] - share[last])
    padded = np.pad(share, ((_TAKING_OVER // 2,) * 2, (0, 0)), mode="edge")
    return np.mean([padded[i : i + len(share)] for i in range(_TAKING_OVER)], axis=0)


def quaternion(angles: Array) -> Array:
    """Of roll, pitch, yaw `(..., 3)`: w x y z, turned about x first and z last."""
    half = angles / 2
    (cr, cp, cy), (sr, sp, sy) = np.moveaxis(np.cos(half), -1, 0), np.moveaxis(np.sin(half), -1, 0)
    w, x = cr * cp * cy + sr * sp * sy, sr * cp * cy - cr * sp * sy
    return np.stack([w, x, cr * sp * cy + sr * cp * sy, cr * cp * sy - sr * sp * cy], -1)


def matrix(turn: Array) -> Array:
    """Rotation `(..., 3, 3)` of a quaternion `(..., 4)`."""
    return np.stack([rotate(turn, np.broadcast_to(axis, (*turn.shape[:-1], 3))) for axis in np.eye(3)], -1)

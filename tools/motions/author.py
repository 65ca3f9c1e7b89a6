"""Clips out of keyframes: poses solved for, and what lies between them."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass, replace

import numpy as np

from servoid.hw.config import ConfigError, nearest
from servoid.hw.contracts.body import Array
from servoid.hw.geometry import turned
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import About, Clip, smooth
from servoid.tools.motions.keyframes import Authored, AuthoredClip, Keyframe
from servoid.tools.motions.standing import Stance, Standing
from servoid.tools.motions.stepped import stepped

AFTER_SECONDS = 0.5  # that the last pose is held
REACHED = 2e-3  # m that a foot or a hand may miss its place by
SPEED_SHARE = 0.95  # of the speed that the guard allows
_STRETCHES = 8
_LIFTED_WEIGHT = 0.25  # of the robot's, that a foot may still be said to carry when it is lifted
_CARRIES = 5e-4  # m: a sole that is no higher is on the ground


Solved = tuple[Array, Array, Array]  # joints, and place and quaternion of the base


@dataclass(frozen=True)
class KeyPose:
    """A stance of one keyframe, before it is solved. `feet` m are from where the soles are at home."""

    height: Array  # ()
    tilt: Array  # (3,)
    weight: Array  # (n_feet,)
    lean: Array  # (2,)
    feet: Array  # (n_feet, 3)
    turn: Array  # (n_feet, 3)
    joints: Array  # (n_joints,)


def author(recipe: Authored, robot: Robot, source: str) -> Iterator[Clip]:
    """The clips of a recipe, and those mirrored from them. Raises ConfigError naming the keyframe that cannot be."""
    maker = Author(robot)
    made: dict[str, KeyPose] = {}
    for wanted in recipe.clips:
        if wanted.after is not None and wanted.after not in made:
            raise ConfigError(f"clip '{wanted.name}': after: '{wanted.after}' is not an earlier clip")
        about = wanted.about(source, recipe.licence)
        if wanted.steps:
            yield from _both(stepped(wanted, robot, about), wanted, robot)
            continue
        start = maker.home if wanted.after is None else made[wanted.after]
        poses = maker.poses(wanted, start)
        made[wanted.name] = poses[-1]
        yield from _both(maker.clip(wanted, [start, *poses], about), wanted, robot)


def _both(clip: Clip, wanted: AuthoredClip, robot: Robot) -> Iterator[Clip]:
    """A clip, and the one mirrored from it where that is wanted."""
    yield clip
    if wanted.mirrored is not None:
        yield clip.mirrored(robot, wanted.mirrored)


class Author:
    """Makes clips of a robot. `middle` `(3,)` m is that of the soles at home. Raises ConfigError for legs of another
    build than `Standing` solves."""

    def __init__(self, robot: Robot) -> None:
        self._robot, self.standing = robot, Standing(robot)
        home = self.standing.home
        n = len(robot.feet)
        self._soles = home.feet[0]
        self.middle = self._soles.mean(0)
        lean = home.centre[0] - self.middle[:2]
        still = np.zeros((n, 3))
        self.home = KeyPose(home.height[0], home.tilt[0], np.full(n, 1.0 / n), lean, still, still, home.joints[0])

    def stand(self, pose: KeyPose) -> Solved:
        """A pose as it stands, without a leading dimension; where legs do not reach, they come as near as they can."""
        joints, place, turn = self.standing.solve(self._stance(_unflat(_flat(pose)[None], pose)))
        return joints[0], place[0], turn[0]

    def offset(self, foot: int, place: Array, heading: float) -> Array:
        """What `feet` of a pose is where the sole of a foot with that heading [rad] is at `place` `(3,)` m."""
        return turned(place - self.middle, -heading) - (self._soles[foot] - self.middle) * [1.0, 1.0, 0.0]

    def poses(self, wanted: AuthoredClip, before: KeyPose) -> list[KeyPose]:
        out = []
        for number, frame in enumerate(wanted.frames, 1):
            before = self._after(frame, before, f"clip '{wanted.name}', keyframe {number}")
            out.append(before)
        return out

    def _after(self, frame: Keyframe, before: KeyPose, where: str) -> KeyPose:
        pose = self.home if frame.home else before
        feet, turn, weight, joints = pose.feet.copy(), pose.turn.copy(), pose.weight.copy(), pose.joints.copy()
        names = list(self._robot.feet)
        for table, values in ((feet, frame.feet), (turn, frame.turn)):
            for foot, value in values.items():
                table[_index(foot, names, where)] = value
        if frame.weight:
            weight = np.zeros(len(names))
            for foot, share in frame.weight.items():
                weight[_index(foot, names, where)] = share
        for joint, angle in frame.joints.items():
            i = _index(joint, self._robot.names, where)
            if i in self.standing.legs.index:
                raise ConfigError(f"{where}: joints.{joint}: is a leg's: say where its foot is with feet")
            joints[i] = angle
        for geom, target in frame.reach.items():
            joints = self._reached(geom, np.array(target), joints, where)
        return replace(
            pose,
            height=pose.height if frame.height is None else np.array(frame.height),
            tilt=pose.tilt if frame.tilt is None else np.array(frame.tilt),
            lean=pose.lean if frame.lean is None else np.array(frame.lean),
            weight=weight,
            feet=feet,
            turn=turn,
            joints=joints,
        )

    def _reached(self, geom: str, target: Array, joints: Array, where: str) -> Array:
        statics = self.standing.statics
        if geom not in statics.geoms:
            raise ConfigError(f"{where}: reach.{geom}: no such geom: {nearest(geom, statics.geoms)}")
        joints, missed = statics.reach(geom, target, joints)
        if missed > REACHED:
            raise ConfigError(f"{where}: reach.{geom}: {1e3 * missed:.0f} mm out of reach: choose a nearer place")
        return joints

    def clip(self, wanted: AuthoredClip, poses: list[KeyPose], about: About) -> Clip:
        """Raises ConfigError naming the keyframe that is out of reach, or where a joint leaves its range."""
        seconds = np.array([frame.seconds for frame in wanted.frames])
        for _ in range(_STRETCHES):
            many, keyframe = self._between(wanted, poses, seconds)
            stance = self._stance(many)
            carries = stance.feet[..., 2] <= _CARRIES
            self._check_weight(wanted.name, keyframe, many.weight, carries)
            solved = self.standing.solve(stance)
            goals = self.standing.loaded(*solved, carries)
            self._check(wanted.name, keyframe, stance, solved, goals)
            fastest = np.abs(np.diff(goals, axis=0)).max(1) / (
                SPEED_SHARE * self._robot.limits.joint_speed * self._robot.dt
            )
            if fastest.max() <= 1.0:
                break
            for number in range(1, len(seconds) + 1):
                seconds[number - 1] *= max(1.0, 1.02 * fastest[keyframe[1:] == number].max())
        else:
            tick = int(fastest.argmax())
            joint = self._robot.names[int(np.abs(goals[tick + 1] - goals[tick]).argmax())]
            raise ConfigError(
                f"clip '{wanted.name}', keyframe {keyframe[tick + 1]}: {joint} is too fast however long it takes: does "
                "a foot leave the ground before the weight is off it?"
            )
        return Clip(wanted.name, goals, *solved[1:], carries.astype(float), about).placed()

    def _between(self, wanted: AuthoredClip, poses: list[KeyPose], seconds: Array) -> tuple[KeyPose, Array]:
        """Poses of all ticks, and the number of the keyframe that each is on the way to."""
        dt = self._robot.dt
        rows, keyframe = [_flat(poses[0])], [0]
        for number, frame in enumerate(wanted.frames, 1):
            before, after = _flat(poses[number - 1]), _flat(poses[number])
            ticks = max(round(seconds[number - 1] / dt), 1)
            rows += [before + share * (after - before) for share in smooth(np.arange(1, ticks + 1) / ticks)]
            hold = frame.hold + (AFTER_SECONDS if number == len(wanted.frames) and not wanted.loop else 0.0)
            rows += [after] * round(hold / dt)
            keyframe += [number] * (len(rows) - len(keyframe))
        return _unflat(np.array(rows), poses[0]), np.array(keyframe)

    def _stance(self, pose: KeyPose) -> Stance:
        heading = pose.turn[..., 2]
        offset = (self._soles - self.middle) * [1.0, 1.0, 0.0] + pose.feet
        feet = self.middle + np.stack([turned(offset[:, i], heading[:, i]) for i in range(offset.shape[1])], 1)
        under = (pose.weight[..., None] * feet[..., :2]).sum(-2)
        yaw = (pose.weight * heading).sum(-1)
        lean = np.concatenate([pose.lean, np.zeros((len(yaw), 1))], -1)
        return Stance(pose.height, pose.tilt, under + turned(lean, yaw)[:, :2], feet, pose.turn, pose.joints)

    def _check_weight(self, name: str, keyframe: Array, weight: Array, carries: Array) -> None:
        early = ~carries & (weight > _LIFTED_WEIGHT)
        if early.any():
            tick, foot = np.argwhere(early)[0]
            raise ConfigError(
                f"clip '{name}', keyframe {keyframe[tick]}: the {list(self._robot.feet)[foot]} foot leaves the ground "
                f"with {weight[tick, foot]:.0%} of the weight on it: shift the weight off it first"
            )

    def _check(self, name: str, keyframe: Array, stance: Stance, solved: Solved, goals: Array) -> None:
        missed = self.standing.miss(stance, *solved)
        if missed.max() > REACHED:
            tick, foot = np.unravel_index(missed.argmax(), missed.shape)
            raise ConfigError(
                f"clip '{name}', keyframe {keyframe[tick]}: the {list(self._robot.feet)[foot]} foot is "
                f"{1e3 * missed.max():.0f} mm out of reach: lower the base, or move the foot nearer"
            )
        robot = self._robot
        beyond = np.maximum(robot.lower - goals, goals - robot.upper) + robot.limits.margin
        if beyond.max() > 1e-6:
            tick, joint = np.unravel_index(beyond.argmax(), beyond.shape)
            raise ConfigError(
                f"clip '{name}', keyframe {keyframe[tick]}: {robot.names[joint]} goes {beyond.max():.2f} rad "
                "beyond its range"
            )


def _index(name: str, names: list[str] | tuple[str, ...], where: str) -> int:
    if name not in names:
        raise ConfigError(f"{where}: unknown '{name}': {nearest(name, names)}")
    return list(names).index(name)


def _flat(pose: KeyPose) -> Array:
    return np.concatenate([np.ravel(np.asarray(value, float)) for value in vars(pose).values()])


def _unflat(rows: Array, like: KeyPose) -> KeyPose:
    """Poses of many ticks: every field with a leading dimension."""
    out, at = {}, 0
    for name, value in vars(like).items():
        shape = np.shape(value)
        size = int(np.prod(shape))
        out[name] = rows[:, at : at + size].reshape(len(rows), *shape)
        at += size
    return KeyPose(**out)

"""How episodes on clips begin: along a clip as it really goes, or lying, settled, however a fall may end."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass, fields, replace

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array, Command, Mode
from servoid.hw.contracts.world import Start
from servoid.hw.geometry import headed, turned, up_vector
from servoid.hw.robot.description import Robot
from servoid.hw.robot.legs import Legs
from servoid.policy.motion.clip import Clip
from servoid.policy.references.clip import ClipReference
from servoid.sim.model import build
from servoid.sim.truth import SimulatedTruth
from servoid.sim.worlds import Worlds
from servoid.stack.control.carrier import LIFTED, PICKS, Carrier
from servoid.stack.control.fleet import Fleet
from servoid.stack.estimation.odometry import load_odometry
from servoid.stack.tasks.learned.carry import Carry
from servoid.tools.learn.collect.carrying import Carrying, box_seen

_SETTLE_SECONDS = 2.0
_FALL_SECONDS = 1.2
_BALANCING = 10  # ticks for which one that is pushed still holds its pose, as before a fall is known
_TIPPED = 0.7  # rad from where it counts as falling
_EVERY = 5  # ticks between states that are kept of a rollout
_DEVIATION = 0.5  # squared error of gravity, seen from the base, that a rollout may have come to
_HEIGHT_DEVIATION = 0.3  # of the standing height, likewise


_ROLLED_OUT = 16  # bodies that follow a clip that is imitated
_CARRIERS, _CARRYING_SECONDS = 24, 14.0  # bodies that carry by a script, and how long it takes to be on the way


@dataclass(frozen=True)
class States:
    """`k` states of bodies to begin in, above the origin, and what they are states of."""

    joints: Array  # (k, n_joints) rad
    position: Array  # (k, 3) m of the base: 0, 0 and its height
    orientation: Array  # (k, 4) quaternion w x y z
    velocity: Array  # (k, 3) m/s of the base, world frame
    angular_velocity: Array  # (k, 3) rad/s, base frame
    joint_velocity: Array  # (k, n_joints) rad/s
    clip: Array  # (k,) index of the clip; -1: none
    time: Array  # (k,) ticks into it

    @classmethod
    def of(cls, truth: SimulatedTruth, rows: Array, clip: Array, time: float) -> States:
        """Of the bodies `rows` now, `time` ticks into the clips `clip` `(k,)`."""
        return cls(
            joints=truth.joints[rows],
            position=truth.position[rows] * np.array([0.0, 0.0, 1.0]),
            orientation=truth.orientation[rows],
            velocity=turned(truth.velocity[rows], truth.yaw[rows]),
            angular_velocity=truth.angular_velocity[rows],
            joint_velocity=truth.joint_velocity[rows],
            clip=clip,
            time=np.full(len(rows), time),
        )

    def only(self, rows: Array) -> States:
        """Those of `rows`, `(k,)` bool or indices."""
        return States(*(getattr(self, field.name)[rows] for field in fields(States)))

    @classmethod
    def joined(cls, parts: Sequence[States]) -> States:
        return cls(*(np.concatenate([getattr(part, field.name) for part in parts]) for field in fields(States)))

    @property
    def front(self) -> Array:
        """Which of them lie on their front, or nearer to that than to their back `(k,)`: ahead is down."""
        return up_vector(self.orientation)[:, 0] < 0.0


def lying(robot: Robot, n: int, seed: int) -> States:
    """`n` nominal robots dropped in any orientation and pose and left to settle, every other one limp."""
    rng = np.random.default_rng([seed, n])
    worlds = Worlds(robot, n)
    reach = rng.uniform(0.1, 1.0, (n, 1))
    joints = robot.home + reach * (rng.uniform(robot.lower, robot.upper, (n, len(robot.joints))) - robot.home)
    quaternion = rng.normal(size=(n, 4))
    quaternion /= np.linalg.norm(quaternion, axis=-1, keepdims=True)
    ids = np.arange(n)
    streams = [np.random.default_rng([seed, i]) for i in range(n)]
    worlds.reset(ids, streams, Start(joints=joints, orientation=quaternion))
    modes = np.where(ids % 2 == 0, Mode.OFF, Mode.ACTIVE)
    # What holds, holds a pose that a run may end in: where the guard's targets are.
    ones = np.ones((n, len(robot.joints)))
    for _ in range(round(_SETTLE_SECONDS * robot.rate)):
        worlds.step(Command(joints, ones, Mode.ACTIVE), modes)
    truth = worlds.truth
    still = np.linalg.norm(truth.angular_velocity, axis=-1) < 0.3
    flat = truth.gravity[:, 2] > -0.5  # it did not come to sit or stand
    keep = np.flatnonzero(still & flat)
    return States.of(truth, keep, np.full(len(keep), -1), 0.0)


def along(robot: Robot, clips: Sequence[Clip], each: int, seed: int) -> States:
    """States of rollouts of the clips, open loop, `each` of a clip, half of them of randomised robots: of those that do
    as the clip does from its beginning to its end."""
    n = each * len(clips)
    fleet = Fleet(robot, n, None, randomise=0.5, seed=seed)
    which = np.repeat(np.arange(len(clips)), each)
    reference = ClipReference(robot, clips, (n,))
    pose = np.stack([clips[i].joints[0] for i in which.tolist()])
    first = Start(
        joints=pose,
        position=np.tile([0.0, 0.0, np.nan], (n, 1)),
        orientation=np.stack([clips[i].root_orientation[0] for i in which.tolist()]),
    )
    fleet.reset(np.ones(n, bool), first)
    for _ in range(round(0.5 * robot.rate)):
        fleet.step(pose)
    reference.play(which)
    good, kept = np.ones(n, bool), []
    for tick in range(max(clip.ticks for clip in clips)):
        running = ~reference.ended
        frames = reference.frames(np.zeros(1, int))
        if tick % _EVERY == 0:
            rows = np.flatnonzero(running)
            kept.append((rows, States.of(fleet.truth, rows, which[rows], float(tick))))
        fleet.step(frames.position[:, 0])
        truth = fleet.truth
        off = ((truth.gravity + up_vector(frames.root_orientation[:, 0])) ** 2).sum(-1) > _DEVIATION
        low = np.abs(truth.position[:, 2] - frames.height[:, 0]) > _HEIGHT_DEVIATION * robot.standing_height
        good &= ~((off | low) & running)
        reference.advance()
    return States.joined([states.only(good[rows]) for rows, states in kept])


def falling(robot: Robot, n: int, seed: int) -> States:
    """States of `n` nominal robots that stand, are pushed over from any side, and brake as they fall and lie."""
    rng = np.random.default_rng([seed, n, 1])
    worlds = Worlds(robot, n)
    ids = np.arange(n)
    worlds.reset(ids, [np.random.default_rng([seed, i, 1]) for i in range(n)], Start())
    angle, size = rng.uniform(-np.pi, np.pi, n), rng.uniform(0.8, 1.6, n)
    worlds.push(size[:, None] * np.stack([np.cos(angle), np.sin(angle)], -1))
    pose, gain = np.tile(robot.home, (n, 1)), np.ones((n, len(robot.joints)))
    kept = []
    for tick in range(round(_FALL_SECONDS * robot.rate)):
        worlds.step(Command(pose, gain if tick < _BALANCING else 0.0 * gain, Mode.ACTIVE))
        rows = np.flatnonzero(worlds.truth.tilt > _TIPPED) if tick % _EVERY == 0 else ids[:0]
        kept.append(States.of(worlds.truth, rows, np.full(len(rows), -1), 0.0))
    return States.joined(kept)


class AlongClip:
    """Draws the states that episodes begin in: a `share` of them along the clip, as it really goes; the others in its
    first pose or, of a loop, standing at home."""

    def __init__(self, robot: Robot, clip: Clip, share: float, seed: int) -> None:
        """Rolls out bodies first. Raises ConfigError where a share is to begin along a clip that fails open loop."""
        self._share, self._states = share, None
        joints, orientation = np.clip(clip.joints[:1], robot.lower, robot.upper), clip.root_orientation[:1]
        if clip.about.loop:
            joints, orientation = robot.home[None], Legs(robot).stand(robot.home[None])[1]
        self._first = joints, orientation
        if share > 0.0:
            self._states = along(robot, [clip], _ROLLED_OUT, seed)
            if not len(self._states.joints):
                raise ConfigError(
                    f"clip '{clip.name}': none of {_ROLLED_OUT} robots comes to its end open loop, so no episode can "
                    "begin along it: use --generated 0"
                )

    def draw(self, rngs: Sequence[np.random.Generator], where: Array) -> Start:
        """Starts of the worlds `where` `(n,)` bool; a row for each world."""
        n = len(where)
        joints, orientation = (np.tile(part, (n, 1)) for part in self._first)
        still = np.zeros((n, 3))
        begin = Start(
            joints=joints, position=np.tile([0.0, 0.0, np.nan], (n, 1)), orientation=orientation, velocity=still,
            angular_velocity=still.copy(), joint_velocity=np.zeros_like(joints),
        )  # fmt: skip
        if self._states is None:
            return begin
        picked = np.full(n, -1)
        for i in np.flatnonzero(where).tolist():
            if rngs[i].random() < self._share:
                picked[i] = rngs[i].integers(len(self._states.joints))
        return _either(picked >= 0, self._states.only(np.maximum(picked, 0)), begin)


def _either(moves: Array, moving: States, begin: Start) -> Start:
    """The states of `moving` in the worlds `moves` `(n,)` bool, those of `begin` elsewhere."""
    parts = ("joints", "position", "orientation", "velocity", "angular_velocity", "joint_velocity")
    chosen = {name: np.where(moves[:, None], vars(moving)[name], getattr(begin, name)) for name in parts}
    return Start(**chosen)


class AlongCarrying:
    """Draws how episodes of carrying begin: standing before a box, or a `share` of them as a script picks one up or
    walks with it."""

    def __init__(self, robot: Robot, share: float, seed: int) -> None:
        """Rolls out the script first. Raises ConfigError where a share is to begin along it and it holds no box."""
        self._task, self._share = Carry(robot), share
        self._states: States | None = None
        self._boxes = np.zeros((0, 1, 7))
        if share > 0.0:
            self._states, self._boxes = _carried(robot, seed)

    def draw(self, rngs: Sequence[np.random.Generator], where: Array) -> Start:
        """Starts of the worlds `where` `(n,)` bool; a row for each world."""
        robot, n = self._task.robot, len(where)
        boxes, picked = np.tile(self._task.place(np.random.default_rng(0)), (n, 1, 1)), np.full(n, -1)
        for i in np.flatnonzero(where).tolist():
            boxes[i] = self._task.place(rngs[i])
            if self._states is not None and rngs[i].random() < self._share:
                picked[i] = rngs[i].integers(len(self._boxes))
        joints = np.tile(robot.home, (n, 1))
        still = np.zeros((n, 3))
        begin = Start(
            joints=joints, position=np.tile([0.0, 0.0, np.nan], (n, 1)),
            orientation=np.tile(Legs(robot).stand(robot.home[None])[1], (n, 1)), velocity=still,
            angular_velocity=still.copy(), joint_velocity=np.zeros_like(joints), objects=boxes,
        )  # fmt: skip
        if self._states is None:
            return begin
        rows = np.maximum(picked, 0)
        found = _either(picked >= 0, self._states.only(rows), begin)
        return replace(found, objects=np.where((picked >= 0)[:, None, None], self._boxes[rows], boxes))


def _carried(robot: Robot, seed: int) -> tuple[States, Array]:
    """States of a nominal robot that picks up and carries, seen from where it is and faces, and of the boxes then
    `(k, 1, 7)`. Raises ConfigError where none is held in the end."""
    worlds = Worlds(robot, _CARRIERS, model=build(robot, Carry(robot).scene))
    fleet, script = Fleet(robot, worlds, load_odometry(robot), seed=seed), Carrying(robot, _CARRIERS)
    carrier, everywhere, kept = Carrier(robot, (_CARRIERS,)), np.ones(_CARRIERS, bool), []
    fleet.draw(everywhere)
    fleet.reset(everywhere, script.start(fleet.rngs, everywhere))
    carrier.reset(None, fleet.seeds)
    for tick in range(round(_CARRYING_SECONDS * robot.rate)):
        state = fleet.observe()
        fleet.step(carrier.act(state, fleet.applied, script.instruction(state, fleet.truth)))
        rows = np.flatnonzero(carrier.stage >= PICKS) if tick % _EVERY == 0 else np.zeros(0, int)
        found, yaw = States.of(fleet.truth, rows, np.full(len(rows), -1), 0.0), fleet.truth.yaw[rows]
        ahead = replace(found, orientation=headed(found.orientation, -yaw), velocity=fleet.truth.velocity[rows].copy())
        kept.append((rows, ahead, box_seen(fleet.truth)[rows][:, None]))
    good = (fleet.truth.objects[:, 0, 2] > LIFTED) & ~script.fallen(fleet.truth)
    states = States.joined([part.only(good[rows]) for rows, part, _ in kept])
    if not len(states.joints):
        raise ConfigError(f"none of {_CARRIERS} robots holds its box in the end: use --generated 0")
    return states, np.concatenate([boxes[good[rows]] for rows, _, boxes in kept])

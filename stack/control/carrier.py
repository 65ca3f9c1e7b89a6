"""Picks up a box and brings it to a place, by a script over the expert: what carrying is learned from.

The expert walks up to the box; there the robot squats by poses of its own, takes the box between its forearms, and
rises; then the expert walks on, and does not see that the arms hold something. Nothing else goes by a clock.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.geometry import rotate
from servoid.hw.robot.description import Robot
from servoid.policy.checkpoint import resolve
from servoid.policy.priors.task_policy import TaskPolicy
from servoid.stack.control.base import BasePolicy
from servoid.stack.control.tracker import ExpertPolicy
from servoid.stack.safety.balance import Balance, Feedback

LIFTED = 0.1  # m above the ground: the middle of a box that is higher is held
APPROACHES, STOPS, PICKS, CARRIES = range(4)  # what it does
_GRIP = 0.165  # m from the base to the middle of a box that it takes
_ALIGNED = (0.02, 0.015, 0.12)  # m ahead, m aside and rad that it may be off where it takes one
_WAITED = 0.1  # s: who rests longer, and should walk, is set going
_ENOUGH, _AWAY = 2.5, 4.0  # times as far off, it goes there again: once it rests, and before
_NEAR = 0.15  # m from there within which steps go in any direction
_REST = (0.5, 0.6)  # rad that targets of legs are off home, and rad/s of their joints: who stands so may squat
# Who rests and should walk is set going by this policy, which sees no clock either: of the first step of a gait that
# goes by one, a pupil learns the mean, and that is to stand.
_FIRST_STEPS = "location"
_BENT = 1.3  # rad of both knees: no walk bends them so
_THERE = 0.03  # m from the place that the box shall come to
_SPEED, _TURN, _FIRST = 0.22, 0.7, 0.9  # m/s, rad/s, and rad of bearing from which it turns on the spot
_TAKEN_IN = 0.5  # s in which the arms come home where it lost the box
# Seconds, knee, lean of the trunk, shoulder pitch and roll, and elbow of the left side [rad]; no knee: as at home.
# Servos that are weak sag forward: with a lean of 0.55 a third of randomised robots fell, with this one none. The arms
# press with nearly what a servo may push with for long.
_OPEN, _CLOSED = (1.3, 0.0), (1.53, -0.37)
_HELD = (-1.05, *_CLOSED)
_PICKING = (
    (0.5, 0.85, 0.05, -0.9, *_OPEN),
    (1.5, 2.35, 0.4, -1.05, *_OPEN),
    (0.7, 2.35, 0.4, -1.05, *_CLOSED),
    (1.5, 0.85, 0.05, *_HELD),
)  # fmt: skip
_RISEN = 15  # ticks before the end of the last it walks on: who errs by more than poses change by, stays
_BALANCE = Balance(ankle_pitch=(0.08, 0.0), hip_pitch=(0.04, 0.0))  # meanwhile; its tilt is meant
_LOOKING_DOWN = 0.4  # rad of the head


class Carrier(BasePolicy):
    """Of one robot, or worlds of any leading `shape`. It goes by where the box is seen, and takes it anew where it lost
    it.

    It picks up from whatever pose it finds, so that who learns from it, and is slower, is told what leads on.
    """

    def __init__(self, robot: Robot, shape: tuple[int, ...] = (), checkpoint: str = "expert") -> None:
        """Raises ConfigError for a robot without the joints, or CheckpointError where the expert does not fit."""
        self._expert = ExpertPolicy(robot, checkpoint, shape)
        self._first = TaskPolicy(robot, resolve(_FIRST_STEPS, robot), shape)
        self._robot, self._dt, self._home = robot, robot.dt, robot.home
        self._picking, self._placed = _picking(robot)
        self._knees = np.array([robot.names.index(name) for name in ("l_knee", "r_knee")])
        held = _pose(robot, None, 0.0, *_HELD)
        self._feedback, self._gains = Feedback(robot), _BALANCE.gains
        self._arms = np.ones(len(robot.joints), bool)
        self._arms[robot.leg_index.ravel()] = False
        self._held = np.where(self._arms, held, robot.home)
        self.stage = np.zeros(shape, int)
        self._plain = np.broadcast_to(robot.home, (*shape, len(robot.joints))).copy()  # the expert's targets, with the
        self._waits = np.zeros(shape)  # s for which it rests where it should walk
        self._share = np.zeros(shape)  # arms where it would have them; of their way from there to where they hold a box

    def reset(self, where: Array | None, seeds: Array) -> None:
        fresh = np.ones_like(self.stage, bool) if where is None else where
        self._expert.reset(where, seeds)
        self._first.reset(where, seeds)
        self._enter(APPROACHES, fresh)
        self._plain = np.where(fresh[..., None], self._home, self._plain)
        self._share = np.where(fresh, 0.0, self._share)

    def _enter(self, stage: int, where: Array) -> None:
        self.stage = np.where(where, stage, self.stage)

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        if instruction.stand:  # where nobody says any more where the box is
            still = np.zeros_like(instruction.velocity)
            return self._walk(state, applied, Instruction(still, goal=still[..., :2], stand=True))
        if instruction.box is None or instruction.goal is None:
            raise ConfigError("the carrier needs a box and a place for it, and the task gives none: run carry")
        box, goal = np.asarray(instruction.box, float), np.asarray(instruction.goal, float)
        approach, off, place = self._to_box(box)
        aligned = off < 1.0
        bring, there = _to_place(box, goal)
        holds = box[..., 2] > LIFTED
        pose = self._next(applied)
        now = self.stage
        bent = (np.abs(applied[..., self._knees]) > _BENT).all(-1)
        rests = self._rests(state, applied)
        self._enter(STOPS, (now == APPROACHES) & (aligned | (rests & (off <= _ENOUGH))))
        self._enter(APPROACHES, (now == STOPS) & (off > np.where(rests, _ENOUGH, _AWAY)))
        self._enter(PICKS, (now == STOPS) & (off <= _ENOUGH) & rests)
        self._enter(PICKS, (now != PICKS) & bent)
        self._enter(CARRIES, rises := (now == PICKS) & (pose >= len(self._picking) - _RISEN))
        self._enter(CARRIES, given := (now < PICKS) & holds & ~bent)
        rises = rises | given
        self._enter(APPROACHES, (now == CARRIES) & ~holds & ~bent)
        if rises.any():
            self._expert.reset(rises, np.zeros_like(self.stage))
            self._plain = np.where(rises[..., None], self._home, self._plain)
        opened = np.maximum(self._share - self._dt / _TAKEN_IN, 0.0)
        self._share = np.where(rises, 1.0, np.where(self.stage == CARRIES, self._share, opened))
        velocity = np.where((self.stage == APPROACHES)[..., None], approach, 0.0)
        velocity = np.where(((self.stage == CARRIES) & ~there)[..., None], bring, velocity)
        self._waits = np.where(rests & velocity.any(-1), self._waits + self._dt, 0.0)
        way = np.where(holds[..., None], goal - box[..., :2], place)
        walked = self._walk(state, applied, Instruction(velocity, goal=way))
        picked = self._feedback(self._picking[pose], state.gravity, state.angular_velocity, self._gains)
        return np.where((self.stage == PICKS)[..., None], picked, walked)

    def _walk(self, state: State, applied: Array, told: Instruction) -> Array:
        """By the expert, who sees the arms where it would have them."""
        hidden = replace(
            state,
            position=np.where(self._arms, self._plain, state.position),
            joint_velocity=np.where(self._arms, 0.0, state.joint_velocity),
        )
        self._plain = self._expert.act(hidden, np.where(self._arms, self._plain, applied), told)
        held = self._arms & (self._share > 0.0)[..., None]
        bare = replace(
            state,
            position=np.where(held, self._home, state.position),
            joint_velocity=np.where(held, 0.0, state.joint_velocity),
        )
        first = self._first.act(bare, np.where(held, self._home, applied), told)
        self._plain = np.where((self._waits > _WAITED)[..., None], first, self._plain)
        upper = self._plain + self._share[..., None] * (self._held - self._plain)
        return np.where(self._arms, upper, self._plain)

    def _next(self, applied: Array) -> Array:
        """Which pose of picking up follows the one that is nearest to what is commanded `(...)` int."""
        off = applied[..., None, self._placed] - self._picking[:, self._placed]
        return np.minimum(np.argmin((off**2).sum(-1), -1) + 1, len(self._picking) - 1)

    def _rests(self, state: State, applied: Array) -> Array:
        off, speed = _REST
        legs = ~self._arms
        there = np.abs(applied - self._home)[..., legs].max(-1) < off
        return there & (np.abs(state.joint_velocity[..., legs]).max(-1) < speed)

    def _to_box(self, box: Array) -> tuple[Array, Array, Array]:
        """The velocity `(..., 3)` to where the box can be taken, how far from there it is, in what it may be off
        `(...)`, and that place `(..., 2)`."""
        angle = facing(box)
        ahead, aside = np.cos(angle), np.sin(angle)
        place = box[..., :2] - _GRIP * np.stack([ahead, aside], -1)
        far = np.linalg.norm(place, axis=-1)
        near = np.concatenate([np.clip(1.5 * place, -0.1, 0.1), np.clip(1.5 * angle, -_TURN, _TURN)[..., None]], -1)
        # First to a point before it, so as to come from ahead.
        before = place - np.minimum(far, _NEAR)[..., None] * np.stack([ahead, aside], -1) * 0.7
        velocity = np.where((far < _NEAR)[..., None], near, _towards(before))
        off = np.abs(np.concatenate([place, angle[..., None]], -1))
        return velocity, (off / _ALIGNED).max(-1), place


def facing(box: Array) -> Array:
    """The heading `(...)` rad, seen from the robot's, in which it is in front of the side of a box that it can take:
    across its y axis, whichever of both sides is turned to it more."""
    x = rotate(box[..., 3:], np.broadcast_to([1.0, 0.0, 0.0], box[..., :3].shape))
    x = x * np.where(x[..., :1] < 0.0, -1.0, 1.0)
    return np.asarray(np.arctan2(x[..., 1], x[..., 0]))


def _to_place(box: Array, goal: Array) -> tuple[Array, Array]:
    """The velocity `(..., 3)` by which a box that is held comes to `goal` `(..., 2)`, and whether it is there `(...)`.

    A box is ahead of the base, so it is the base that turns to the place, and goes less far.
    """
    away, reach = np.linalg.norm(goal, axis=-1), np.linalg.norm(box[..., :2], axis=-1)
    bearing = np.arctan2(goal[..., 1], goal[..., 0])
    left = away - reach
    way = np.stack([np.cos(bearing), np.sin(bearing)], -1) * np.maximum(np.abs(left), 0.02)[..., None]
    velocity = _towards(way)
    near = np.abs(left) < _THERE
    velocity[..., 0] = np.where(left < 0.0, -0.08, velocity[..., 0])
    off = np.linalg.norm(goal - box[..., :2], axis=-1)
    velocity[..., 0] = np.where(near, 0.0, velocity[..., 0])
    return velocity, off < _THERE


def _towards(point: Array) -> Array:
    """The velocity `(..., 3)` to a point `(..., 2)` of the heading frame: turn to it, and walk."""
    distance, bearing = np.linalg.norm(point, axis=-1), np.arctan2(point[..., 1], point[..., 0])
    edge = np.cos(_FIRST)
    ahead = np.maximum((np.cos(bearing) - edge) / (1.0 - edge), 0.0)
    speed = np.clip(0.8 * distance, 0.08, _SPEED)
    turn = np.clip(1.5 * bearing, -_TURN, _TURN)
    return np.stack([speed * ahead, np.zeros_like(speed), turn], -1)


def _picking(robot: Robot) -> tuple[Array, Array]:
    """Poses of picking up, a tick apart `(ticks, n_joints)` rad, and the joints that tell them apart."""
    poses, before = [], robot.home
    for seconds, *key in _PICKING:
        after = _pose(robot, *key)
        share = (np.arange(round(seconds * robot.rate)) + 1.0)[:, None] / round(seconds * robot.rate)
        poses.append(before + share * (after - before))
        before = after
    telling = [name for name in robot.names if name.endswith(("_knee", "_sho_pitch", "_sho_roll", "_el"))]
    return np.concatenate(poses), np.array([robot.names.index(name) for name in telling])


def _pose(robot: Robot, knee: float | None, lean: float, shoulder: float, roll: float, elbow: float) -> Array:
    """Joints `(n_joints,)` rad; `lean` is that of the trunk over legs bent so far. Raises ConfigError."""
    pose, mirror, sign = robot.home.copy(), *robot.mirror
    wanted = {"l_sho_pitch": shoulder, "l_sho_roll": roll, "l_el": elbow, "head_tilt": -_LOOKING_DOWN}
    if knee is not None:
        wanted |= {"l_knee": knee, "l_hip_pitch": -(knee / 2 + lean), "l_ank_pitch": knee / 2}
    lacking = [name for name in wanted if name not in robot.names]
    if lacking:
        raise ConfigError(f"{robot.name} has no joint {lacking[0]}: the carrier is for a robot like an OP3")
    for name, value in wanted.items():
        joint = robot.names.index(name)
        pose[joint] = value
        if mirror[joint] != joint:
            pose[mirror[joint]] = sign[joint] * value
    return pose

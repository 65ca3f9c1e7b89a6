"""Picks up a box and brings it to a place, by a script over the expert: what carrying is learned from.

The expert walks up to the box; there the robot squats by poses of its own, takes the box between its forearms, and
rises; then the expert walks on, and does not see that the arms hold something.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.geometry import rotate
from servoid.hw.robot.description import Robot
from servoid.stack.control.base import BasePolicy
from servoid.stack.control.tracker import ExpertPolicy
from servoid.stack.safety.balance import Balance, Feedback

LIFTED = 0.1  # m above the ground: the middle of a box that is higher is held
APPROACHES, STOPS, PICKS, CARRIES = range(4)  # what it does
_GRIP = 0.165  # m from the base to the middle of a box that it takes
_ALIGNED = (0.02, 0.015, 0.12)  # m ahead, m aside and rad that it may be off where it takes one
_NEAR = 0.15  # m from there within which steps go in any direction
_STILL = 0.6  # s of standing before it squats
_THERE = 0.03  # m from the place that the box shall come to
_SPEED, _TURN, _FIRST = 0.22, 0.7, 0.9  # m/s, rad/s, and rad of bearing from which it turns on the spot
_TAKEN_IN = 0.5  # s in which the arms come home where it lost the box
# Seconds, knee, lean of the trunk, shoulder pitch and roll, and elbow of the left side [rad]; no knee: as at home.
# Servos that are weak sag forward: with a lean of 0.55 a third of randomised robots fell, with this one none. The arms
# press with nearly what a servo may push with for long.
_OPEN, _CLOSED = (1.3, 0.0), (1.53, -0.27)
_HELD = (-1.05, *_CLOSED)
_PICKING = (
    (0.5, 0.85, 0.05, -0.9, *_OPEN),
    (1.2, 2.35, 0.4, -1.05, *_OPEN),
    (0.3, 2.35, 0.4, -1.05, *_OPEN),
    (0.5, 2.35, 0.4, -1.05, *_CLOSED),
    (0.2, 2.35, 0.4, -1.05, *_CLOSED),
    (1.2, 0.85, 0.05, *_HELD),
    (0.4, None, 0.0, *_HELD),
)  # fmt: skip
_BALANCE = Balance(ankle_pitch=(0.08, 0.0), hip_pitch=(0.04, 0.0))  # meanwhile; its tilt is meant
_LOOKING_DOWN = 0.4  # rad of the head


class Carrier(BasePolicy):
    """Of one robot, or worlds of any leading `shape`. It goes by where the box is seen, and takes it anew where it lost
    it."""

    def __init__(self, robot: Robot, shape: tuple[int, ...] = (), checkpoint: str = "expert") -> None:
        """Raises ConfigError for a robot without the joints, or CheckpointError where the expert does not fit."""
        self._expert = ExpertPolicy(robot, checkpoint, shape)
        self._robot, self._dt, self._home = robot, robot.dt, robot.home
        seconds = np.array([key[0] for key in _PICKING])
        self._ends = np.cumsum(seconds)
        self._begins = self._ends - seconds
        self._poses = np.stack([_pose(robot, *key[1:]) for key in _PICKING])
        held = _pose(robot, None, 0.0, *_HELD)
        self._feedback, self._gains = Feedback(robot), _BALANCE.gains
        self._arms = np.ones(len(robot.joints), bool)
        self._arms[robot.leg_index.ravel()] = False
        self._held = np.where(self._arms, held, robot.home)
        self.stage = np.zeros(shape, int)
        self._since = np.zeros(shape)  # s in that stage
        self._from = np.broadcast_to(robot.home, (*shape, len(robot.joints))).copy()  # where picking began
        self._plain = self._from.copy()  # the expert's targets, with the arms where it would have them
        self._share = np.zeros(shape)  # of the arms' way from there to where they hold a box

    def reset(self, where: Array | None, seeds: Array) -> None:
        fresh = np.ones_like(self.stage, bool) if where is None else where
        self._expert.reset(where, seeds)
        self._enter(APPROACHES, fresh)
        self._plain = np.where(fresh[..., None], self._home, self._plain)
        self._share = np.where(fresh, 0.0, self._share)

    def _enter(self, stage: int, where: Array) -> None:
        self.stage = np.where(where, stage, self.stage)
        self._since = np.where(where, 0.0, self._since)

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        if instruction.stand:  # where nobody says any more where the box is
            return self._walk(state, applied, Instruction(np.zeros_like(instruction.velocity)))
        if instruction.box is None or instruction.goal is None:
            raise ConfigError("the carrier needs a box and a place for it, and the task gives none: run carry")
        box, goal = np.asarray(instruction.box, float), np.asarray(instruction.goal, float)
        self._since = self._since + self._dt
        approach, aligned = self._to_box(box)
        bring, there = _to_place(box, goal)
        stands = self._since > _STILL
        holds = box[..., 2] > LIFTED
        now = self.stage
        self._enter(STOPS, (now == APPROACHES) & aligned)
        self._enter(PICKS, begins := (now == STOPS) & stands & aligned)
        self._from = np.where(begins[..., None], applied, self._from)
        self._enter(APPROACHES, (now == STOPS) & stands & ~aligned)
        self._enter(CARRIES, rises := (now == PICKS) & (self._since >= self._ends[-1]))
        self._enter(APPROACHES, (now == CARRIES) & ~holds & (self._since > _STILL))
        if rises.any():
            self._expert.reset(rises, np.zeros_like(self.stage))
            self._plain = np.where(rises[..., None], self._home, self._plain)
        opened = np.maximum(self._share - self._dt / _TAKEN_IN, 0.0)
        self._share = np.where(rises, 1.0, np.where(self.stage == CARRIES, self._share, opened))
        velocity = np.where((self.stage == APPROACHES)[..., None], approach, 0.0)
        carries = (self.stage == CARRIES) & (self._since > _STILL) & ~there
        velocity = np.where(carries[..., None], bring, velocity)
        walked = self._walk(state, applied, Instruction(velocity))
        picked = self._feedback(self._picked(), state.gravity, state.angular_velocity, self._gains)
        return np.where((self.stage == PICKS)[..., None], picked, walked)

    def _walk(self, state: State, applied: Array, told: Instruction) -> Array:
        """By the expert, who sees the arms where it would have them."""
        hidden = replace(
            state,
            position=np.where(self._arms, self._plain, state.position),
            joint_velocity=np.where(self._arms, 0.0, state.joint_velocity),
        )
        self._plain = self._expert.act(hidden, np.where(self._arms, self._plain, applied), told)
        upper = self._plain + self._share[..., None] * (self._held - self._plain)
        return np.where(self._arms, upper, self._plain)

    def _picked(self) -> Array:
        """Where the poses of picking up are now `(..., n_joints)`."""
        key = np.minimum((self._since[..., None] >= self._ends).sum(-1), len(self._ends) - 1)
        share = np.clip((self._since - self._begins[key]) / (self._ends - self._begins)[key], 0.0, 1.0)
        share = (share * share * (3.0 - 2.0 * share))[..., None]
        before = np.where((key == 0)[..., None], self._from, self._poses[np.maximum(key - 1, 0)])
        return np.asarray(before + share * (self._poses[key] - before))

    def _to_box(self, box: Array) -> tuple[Array, Array]:
        """The velocity `(..., 3)` to where the box can be taken, and whether it is there `(...)`."""
        angle = facing(box)
        ahead, aside = np.cos(angle), np.sin(angle)
        place = box[..., :2] - _GRIP * np.stack([ahead, aside], -1)
        far = np.linalg.norm(place, axis=-1)
        near = np.concatenate([np.clip(1.5 * place, -0.1, 0.1), np.clip(1.5 * angle, -_TURN, _TURN)[..., None]], -1)
        # First to a point before it, so as to come from ahead.
        before = place - np.minimum(far, _NEAR)[..., None] * np.stack([ahead, aside], -1) * 0.7
        velocity = np.where((far < _NEAR)[..., None], near, _towards(before))
        off = np.abs(np.concatenate([place, angle[..., None]], -1))
        return velocity, (off < np.array(_ALIGNED)).all(-1)


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

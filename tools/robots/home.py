"""A home pose with bent knees, by geometry, for a model that says none."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.hw.robot.inverse import NumericInverse, stance_at_home
from servoid.hw.robot.legs import Legs
from servoid.sim.model import build
from servoid.tools.robots.compare import steps

_LOWERED = (0.07, 0.1, 0.13)  # of a leg's length that the base comes down: knees of equal halves bend by 0.75 to 1 rad
_HIGHER = 0.02  # of it, that a leg reaches down further where its knee is bent already
_REACHED = 0.25  # of that
_ROUNDS = 4  # of shifting the feet under the centre of mass
_FLEX = 0.8  # rad of the knees from which a bent pose is looked for
_EVEN = 0.1  # rad, of a range's middle, from which a knee has no side


def drafted_home(robot: Robot) -> Array | None:
    """As `bent_home`, but bent as far as it takes for servos to follow the gait's steps."""
    best = bent_home(robot)
    for lowered in _LOWERED[1:]:
        if best is None or steps(_at(robot, best)).good:
            break
        lower = bent_home(robot, lowered)
        best = best if lower is None else lower
    return best


def _at(robot: Robot, pose: Array) -> Robot:
    joints = (replace(joint, home=float(at)) for joint, at in zip(robot.joints, pose, strict=True))
    return replace(robot, joints=tuple(joints))


def bent_home(robot: Robot, lowered: float = _LOWERED[0]) -> Array | None:
    """Joints `(n_joints,)` rad that stand lower than at home by `lowered` of a leg's length, soles level, the centre of
    mass above their middle; None where legs are bent already, or do not reach such a pose. Knees that bend to either
    side are given one."""
    legs = Legs(robot)
    at, turn, _, _ = legs.forward(legs.pick(robot.home))
    turn = _level(turn)
    down = np.array([0.0, 0.0, stance_at_home(robot, legs).height])
    kneed = _with_knees(robot, legs)
    inverse = NumericInverse(kneed, legs)

    def misses(q: Array, goal: Array) -> bool:
        return bool(np.linalg.norm(legs.forward(q)[0] - goal, axis=-1).max() > _REACHED * _HIGHER * down[2])

    if not misses(inverse(lower := at - _HIGHER * down, turn), lower):
        return None
    inverse = NumericInverse(_flexed(kneed, legs), legs)  # from straight knees, some go on to the wrong side
    model = build(robot)
    data = mujoco.MjData(model)
    joints = [int(model.joint(name).qposadr[0]) for name in robot.names]
    pose, goal = robot.home.copy(), at + lowered * down
    for _ in range(_ROUNDS):
        pose[legs.index] = inverse(goal, turn)
        if misses(legs.pick(pose), goal):
            return None
        data.qpos[:] = np.eye(1, model.nq, 3)[0]
        data.qpos[joints] = pose
        mujoco.mj_fwdPosition(model, data)
        base = model.body(robot.base).id
        ahead = float((data.subtree_com[base] - data.xpos[base])[0])
        soles, _ = legs.soles(legs.pick(pose))
        goal = goal + np.array([ahead - float(soles[:, 0].mean()), 0.0, 0.0])
    index, sign = robot.mirror
    return (pose + pose[index] * sign) / 2


def _with_knees(robot: Robot, legs: Legs) -> Robot:
    """The robot with each knee, the second joint of a leg that pitches, kept to one side where its range has none: to
    that which leaves the hip more room, as it turns the other way, or else to that of a person's."""
    _, _, _, axes = legs.forward(legs.pick(robot.home))
    joints = list(robot.joints)
    for index, axis in zip(legs.index, axes, strict=True):
        pitching = np.flatnonzero(np.abs(axis[:, 1]) > 0.7)
        if len(pitching) < 2:
            continue
        hip, knee = joints[int(index[pitching[0]])], joints[int(index[pitching[1]])]
        low, high = knee.range
        if abs(low + high) / 2 > _EVEN:
            continue
        same = np.sign(axis[pitching[0]] @ axis[pitching[1]])
        more = -same * (hip.range[0] + hip.range[1] - 2 * hip.home)  # of the hip's room, where the knee's angle grows
        onwards = more > 0 if abs(more) > _EVEN else axis[pitching[1], 1] > 0
        joints[int(index[pitching[1]])] = replace(knee, range=(0.0, high) if onwards else (low, 0.0))
    return replace(robot, joints=tuple(joints))


def _level(turn: Array) -> Array:
    """Soles turned as these `(..., 3, 3)` about the vertical alone."""
    yaw = np.arctan2(turn[..., 1, 0], turn[..., 0, 0])
    zero, one = np.zeros_like(yaw), np.ones_like(yaw)
    rows = [[np.cos(yaw), -np.sin(yaw), zero], [np.sin(yaw), np.cos(yaw), zero], [zero, zero, one]]
    return np.stack([np.stack(row, -1) for row in rows], -2)


def _flexed(robot: Robot, legs: Legs) -> Robot:
    """The robot whose home has its knees bent into their ranges, hips and ankles half as far the other way."""
    _, _, _, axes = legs.forward(legs.pick(robot.home))
    joints = list(robot.joints)
    for index, axis in zip(legs.index, axes, strict=True):
        pitching = np.flatnonzero(np.abs(axis[:, 1]) > 0.7)[:3]
        if len(pitching) < 3:
            continue
        knee = joints[int(index[pitching[1]])]
        way = np.sign((sum(knee.range) / 2 - knee.home) * axis[pitching[1], 1])
        for part, share in zip(pitching, (-0.5, 1.0, -0.5), strict=True):
            joint = joints[int(index[part])]
            bent = joint.home + _FLEX * share * way * np.sign(axis[part, 1])
            joints[int(index[part])] = replace(joint, home=float(np.clip(bent, *joint.range)))
    return replace(robot, joints=tuple(joints))

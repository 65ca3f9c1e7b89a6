"""Where a robot's joints are, by its model."""

from __future__ import annotations

import mujoco
import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.hw.robot.limbs import Limb, Limbs
from servoid.sim.model import build


def joint_places(robot: Robot, joints: Array) -> Array:
    """Places `(n, n_joints, 3)` m of the joints in the base frame, at poses `joints` `(n, n_joints)` rad."""
    model = build(robot)
    data = mujoco.MjData(model)
    ids = [model.joint(name).id for name in robot.names]
    at = model.jnt_qposadr[ids]
    places = np.zeros((len(joints), len(ids), 3))
    data.qpos[:7] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    for row, pose in enumerate(joints):
        data.qpos[at] = pose
        mujoco.mj_kinematics(model, data)
        places[row] = data.xanchor[ids]
    return places


def limbs_of(robot: Robot) -> Limbs:
    """Arms and legs by the robot's model: whatever ends in a body beyond three joints or more, as far as its middle."""
    model = build(robot)
    data = mujoco.MjData(model)
    data.qpos[:7] = [0.0, 0.0, 0.0, 1.0, 0.0, 0.0, 0.0]
    joints = [model.joint(name).id for name in robot.names]
    data.qpos[model.jnt_qposadr[joints]] = 0.0
    mujoco.mj_kinematics(model, data)
    base = model.body(robot.base).id
    parents = set(model.body_parentid.tolist())
    found = []
    for leaf in (body for body in range(model.nbody) if body not in parents):
        chain: list[int] = []
        body = leaf
        while body not in (0, base):
            start, count = model.body_jntadr[body], model.body_jntnum[body]
            chain[:0] = range(start, start + count)
            body = model.body_parentid[body]
        if body == base and len(chain) >= 3 and set(chain) <= set(joints):
            numbers = tuple(joints.index(joint) for joint in chain)
            places = (data.xanchor[chain], data.xaxis[chain], data.xipos[leaf])
            found.append(Limb(numbers, *(place.copy() for place in places)))
    return Limbs(tuple(found))

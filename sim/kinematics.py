"""Where a robot's joints are, by its model."""

from __future__ import annotations

import mujoco
import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
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

"""Which way a joint turns, in words for a person who holds the robot."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot

_LEVER = 0.015  # m: what lies closer to the axis hardly moves
_WORDS = (("forward", "backward"), ("left", "right"), ("up", "down"))  # of the base's axes


def describe_turns(robot: Robot, pose: Array, signs: Array) -> list[str]:
    """For each joint, what turning it by `signs` `(n_joints,)` from `pose` `(n_joints,)` rad looks like.

    Directions are those of a robot that stands upright. Raises ConfigError when its model does not fit its file.
    """
    import mujoco

    from servoid.sim.model import build

    model = build(robot)
    data = mujoco.MjData(model)
    for name, angle in zip(robot.names, pose.tolist(), strict=True):
        data.qpos[model.joint(name).qposadr[0]] = angle
    base = model.body(robot.base).jntadr[0]
    start = model.jnt_qposadr[base]
    data.qpos[start + 3 : start + 7] = 1.0, 0.0, 0.0, 0.0
    mujoco.mj_forward(model, data)
    texts = []
    for name, sign in zip(robot.names, signs.tolist(), strict=True):
        joint = model.joint(name)
        axis = sign * data.xaxis[joint.id]
        arm = data.subtree_com[joint.bodyid[0]] - data.xanchor[joint.id]
        thumb = f"right-hand rule, thumb {_direction(axis)}"
        moved = np.cross(axis, arm)
        if np.linalg.norm(moved) < _LEVER:
            texts.append(f"it turns by the {thumb}")
        else:
            texts.append(f"what it carries goes {_direction(moved)} ({thumb})")
    return texts


def _direction(vector: Array) -> str:
    """The base's axis that a vector `(3,)` goes along most."""
    axis = int(np.abs(vector).argmax())
    return _WORDS[axis][int(vector[axis] < 0.0)]

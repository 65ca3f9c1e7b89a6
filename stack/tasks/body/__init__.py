"""Tasks about parts of the robot's body, and what they need to know of it."""

from __future__ import annotations

import numpy as np

from servoid.hw.robot.description import Robot
from servoid.hw.robot.legs import Legs
from servoid.hw.robot.limbs import Limb
from servoid.stack.safety.lowering import lowered_pose
from servoid.stack.tasks.terms.body import Build

HANDS = ("left hand", "right hand")
_POSES = 4000  # of an arm that are tried, to see how far it reaches


def build_of(robot: Robot) -> Build:
    """Arms and height of a robot, by its MJCF. Raises ConfigError where that cannot be read."""
    from servoid.policy.diffusion.prefix.key_points import KeyPoints

    points = KeyPoints(robot)
    return Build({name: points.limb(name) for name in HANDS if name in points.names}, _top(robot))


def reachable_heights(robot: Robot, limb: Limb) -> tuple[float, float]:
    """Lowest and highest place of a limb's end above the ground [m], of a robot that stands at home."""
    joints, margin = list(limb.joints), robot.limits.margin
    poses = np.tile(robot.home, (_POSES, 1))
    drawn = np.random.default_rng(0).uniform(size=(_POSES, len(joints)))
    low, high = robot.lower[joints] + margin, robot.upper[joints] - margin
    poses[:, joints] = low + (high - low) * drawn
    heights = limb.end(poses)[0][:, 2] + robot.standing_height
    return float(heights.min()), float(heights.max())


def lowest_top(robot: Robot, build: Build) -> float:
    """Height of the robot's highest part above the ground [m] when it crouches as low as the guard lowers it."""
    legs = Legs(robot)
    home, low = (legs.forward(legs.pick(pose))[0][:, 2].mean() for pose in (robot.home, lowered_pose(robot)))
    return build.top + robot.standing_height - float(low - home)


def _top(robot: Robot) -> float:
    """How far the highest point of the robot's body is above its base at home [m]."""
    import mujoco

    from servoid.hw.robot.mjcf import compiled, read_body

    model = compiled(read_body(robot), robot.mjcf)
    data = mujoco.MjData(model)
    data.qpos[model.jnt_qposadr[[model.joint(name).id for name in robot.names]]] = robot.home
    mujoco.mj_kinematics(model, data)
    base = model.body(robot.base).id
    tops = []
    for geom in np.flatnonzero(model.geom_contype | model.geom_conaffinity):
        middle, half = model.geom_aabb[geom, :3], model.geom_aabb[geom, 3:]
        turn = data.geom_xmat[geom].reshape(3, 3)
        if model.body_rootid[model.geom_bodyid[geom]] == model.body_rootid[base]:
            tops.append(data.geom_xpos[geom, 2] + turn[2] @ middle + np.abs(turn[2]) @ half)
    return float(max(tops) - data.xpos[base, 2])

"""How far the links of a robot are from where a clip has them."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import headed, rotate, yaw_of
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import Clip
from servoid.tools.motions.physics import Played
from servoid.tools.motions.standing import Standing


def body_error(played: Played, clip: Clip, robot: Robot) -> Array:
    """Mean distance [m] of a robot's links from those of the clip, for each world `(n,)`; NaN where none was seen.

    Links are seen from the base, in its heading frame, so the trunk's tilt counts and where the robot is does not.
    Averaged over links and the clip's ticks until a fall. The clip's pose is that in which servos under the robot's
    weight hold its goals.
    """
    wanted = _links(robot, Standing(robot).held(clip), clip.root_orientation)
    ticks = min(clip.ticks, played.joints.shape[1])
    errors = np.full(len(played.joints), np.nan)
    for world, fallen in enumerate(played.fallen):
        upright = int(np.argmax(fallen[:ticks])) if fallen[:ticks].any() else ticks
        if clip.about.begins != "upright":
            upright = ticks  # who begins lying has not fallen
        if upright:
            seen = _links(robot, played.joints[world, :upright], played.orientation[world, :upright])
            errors[world] = np.linalg.norm(seen - wanted[:upright], axis=-1).mean()
    return errors


def _links(robot: Robot, joints: Array, orientation: Array) -> Array:
    """Places of the links `(ticks, links, 3)` m from the base, in its heading frame."""
    import mujoco

    from servoid.sim.model import build

    model = build(robot)
    data = mujoco.MjData(model)
    at = [int(model.joint(name).qposadr[0]) for name in robot.names]
    links = sorted({int(model.joint(name).bodyid[0]) for name in robot.names})
    places = np.empty((len(joints), len(links), 3))
    for tick, row in enumerate(joints):
        data.qpos[at] = row
        data.qpos[3:7] = 1.0, 0.0, 0.0, 0.0
        mujoco.mj_kinematics(model, data)
        places[tick] = data.xpos[links] - data.xpos[model.body_rootid[links[0]]]
    level = headed(orientation, -yaw_of(orientation))
    return rotate(level[:, None], places)

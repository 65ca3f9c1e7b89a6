"""Frames of a robot's motion, drawn off screen.

MuJoCo chooses how to draw when it is first imported: on a machine without a display set MUJOCO_GL=egl before.
"""

from __future__ import annotations

import time
from collections.abc import Iterator

import mujoco
import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.hw.robot.mjcf import compiled
from servoid.sim.marks import Frame, draw
from servoid.sim.model import spec
from servoid.sim.multi_robot import prefix

AZIMUTH, ELEVATION, DISTANCE = 140.0, -20.0, 5.02  # degrees and standing heights, of the camera that follows the robot
CLOSE, LOOK = 3.67, 0.77  # standing heights: how near a camera of a given azimuth is, and how high it looks
ABOVE, ROOM = -40.0, 0.8  # degrees, and m for each m between robots, of the camera that shows several of them
ASIDE = 30.0  # degrees that it looks past the goal, where there is one: both are in the picture all the way
FOLLOW = 0.08  # share of the way to the robot that the camera goes each frame: calm, yet never far behind
GHOST_COLOUR = (0.55, 0.60, 0.85, 0.22)
QUICK = 0.02  # s that a picture with shadows may take: two cores in software take 0.23 s for it, and 0.06 s without
SHADOW_SIZE = 4096  # pixels of the shadow map: with fewer, soles are speckled
SHADOW_REACH = 3.0  # times the model's size: speckles at its edge are outside the picture
_ROOM = 2000  # geoms in a scene, of which the trail takes what is left


class RenderError(Exception):
    """No frames can be drawn on this machine."""


def render(
    robot: Robot,
    frames: list[Frame],
    width: int = 1280,
    height: int = 720,
    shadows: bool | None = None,
    azimuth: float | None = None,
) -> Iterator[Array]:
    """Pictures `(height, width, 3)` uint8 of `frames`, which all show as many robots.

    `shadows` None: where drawing is quick enough. `azimuth` [degrees] is the camera's, instead of its own choice: at
    180 it sees the front of a robot that faces along x, at 90 its right side. Raises RenderError when there is no way
    to draw.
    """
    others = 0 if not frames or frames[0].robots is None else len(frames[0].robots)
    model = compiled(spec(robot, 1 + others), robot.mjcf)
    model.vis.quality.offsamples = 0  # in software, smoothing takes as long again
    model.vis.quality.shadowsize, model.vis.map.shadowclip = SHADOW_SIZE, SHADOW_REACH
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    data, ghost = mujoco.MjData(model), mujoco.MjData(model)
    try:
        renderer = mujoco.Renderer(model, height, width, max_geom=_ROOM)
    except Exception as error:  # each way of drawing raises its own kind
        raise RenderError(f"cannot draw on this machine ({error}): try MUJOCO_GL=egl or MUJOCO_GL=osmesa") from error
    with renderer:
        flags = renderer.scene.flags
        flags[mujoco.mjtRndFlag.mjRND_REFLECTION] = False
        flags[mujoco.mjtRndFlag.mjRND_SHADOW] = shadows is not False
        camera = _camera(robot, frames[0]) if frames else mujoco.MjvCamera()
        if azimuth is not None:
            camera.azimuth, camera.distance = azimuth, CLOSE * robot.standing_height
        trail: list[Array] = []
        for number, frame in enumerate(frames):
            _pose(model, data, robot, frame)
            for other in range(1, others + 1):
                _stand(model, data, robot, other, frame)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            data.light_xpos[:, :2] += frame.place[:2]  # the sun's shadow reaches some metres: it goes with the robot
            places = _places(frame)
            camera.lookat[:2] += FOLLOW * (places.mean(0) - camera.lookat[:2])
            if azimuth is not None:
                camera.lookat[:] = *frame.place[:2], LOOK * robot.standing_height
            renderer.update_scene(data, camera)
            if not trail or np.linalg.norm(frame.place[:2] - trail[-len(places)]) > 0.02:
                trail += list(places)
            for pose in frame.ghosts:
                _haunt(renderer.scene, model, ghost, robot, pose)
            draw(renderer.scene, frame, trail)
            if shadows is None and number == 0:
                flags[mujoco.mjtRndFlag.mjRND_SHADOW] = _seconds(renderer) < QUICK
            yield renderer.render()


def _seconds(renderer: mujoco.Renderer) -> float:
    """How long a picture takes, the second one: with the first come compilations."""
    renderer.render()
    began = time.perf_counter()
    renderer.render()
    return time.perf_counter() - began


def _camera(robot: Robot, first: Frame) -> mujoco.MjvCamera:
    """One that follows the robot, or several."""
    camera = mujoco.MjvCamera()
    camera.azimuth, camera.elevation, camera.distance = AZIMUTH, ELEVATION, DISTANCE * robot.standing_height
    camera.lookat[:] = first.place
    if first.goal is not None:
        ahead = first.goal - first.place[:2]
        camera.azimuth = np.degrees(np.arctan2(ahead[1], ahead[0])) + ASIDE
    if first.robots is not None and len(first.robots):
        places = _places(first)
        camera.lookat[:2], camera.elevation = places.mean(0), ABOVE
        camera.distance += ROOM * float(np.ptp(places, axis=0).max())
    return camera


def _places(frame: Frame) -> Array:
    """Where robots are in a frame `(n, 2)` m, the one that is shown moving first."""
    return np.vstack([frame.place[:2], *(frame.robots[:, :2] if frame.robots is not None else ())])


def _pose(model: mujoco.MjModel, data: mujoco.MjData, robot: Robot, frame: Frame) -> None:
    """Put the robot where the frame has it."""
    joints = [int(model.joint(name).qposadr[0]) for name in robot.names]
    data.qpos[0:3], data.qpos[3:7], data.qpos[joints] = frame.place, frame.orientation, frame.joints


def _stand(model: mujoco.MjModel, data: mujoco.MjData, robot: Robot, number: int, frame: Frame) -> None:
    """Put another robot, by its number, where the frame has it."""
    assert frame.robots is not None
    x, y, heading = frame.robots[number - 1]
    joints = [int(model.joint(prefix(number) + name).qposadr[0]) for name in robot.names]
    base = number * (model.nq // (1 + len(frame.robots)))
    data.qpos[base : base + 7] = x, y, robot.standing_height, np.cos(heading / 2), 0.0, 0.0, np.sin(heading / 2)
    data.qpos[joints] = robot.home


def _haunt(scene: mujoco.MjvScene, model: mujoco.MjModel, data: mujoco.MjData, robot: Robot, pose: Frame) -> None:
    """Add the robot in a pose to be in later, as one that can be seen through."""
    _pose(model, data, robot, pose)
    mujoco.mj_kinematics(model, data)
    first, bodies = scene.ngeom, mujoco.mjtCatBit.mjCAT_DYNAMIC
    mujoco.mjv_addGeoms(model, data, mujoco.MjvOption(), mujoco.MjvPerturb(), int(bodies), scene)
    for geom in scene.geoms[first : scene.ngeom]:
        geom.rgba[:] = GHOST_COLOUR


__all__ = ["Frame", "RenderError", "render"]

"""Frames of a robot's motion, drawn off screen.

MuJoCo chooses how to draw when it is first imported: on a machine without a display set MUJOCO_GL=egl before.
"""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import dataclass

import mujoco
import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.sim.model import compiled, spec
from servoid.sim.multi_robot import prefix
from servoid.sim.scene import PILLAR_COLOUR, PILLAR_HEIGHT, SPHERE_COLOUR

AZIMUTH, ELEVATION, DISTANCE = 140.0, -20.0, 1.3  # degrees and m, of the camera that follows the robot
ABOVE, ROOM = -40.0, 0.8  # degrees, and m for each m between robots, of the camera that shows several of them
ASIDE = 30.0  # degrees that it looks past the goal, where there is one: both are in the picture all the way
FOLLOW = 0.08  # share of the way to the robot that the camera goes each frame: calm, yet never far behind
GOAL_COLOUR = (0.15, 0.65, 0.30, 0.8)
TRAIL_COLOUR = (0.20, 0.35, 0.75, 0.9)
PLAN_COLOUR = (0.95, 0.55, 0.10, 0.9)
_ROOM = 2000  # geoms in a scene, of which the trail takes what is left


class RenderError(Exception):
    """No frames can be drawn on this machine."""


@dataclass(frozen=True)
class Frame:
    """What one picture shows, all in one frame of reference whose z is up and zero on the ground."""

    place: Array  # (3,) m of the base
    orientation: Array  # (4,) quaternion w x y z
    joints: Array  # (n_joints,) rad
    goal: Array | None = None  # (2,) m
    plan: Array | None = None  # (n, 2) m: where the robot means to go
    pillars: Array | None = None  # (n, 3) m: x, y, radius
    spheres: Array | None = None  # (n, 3) m: x, y, radius; they lie on the ground
    robots: Array | None = None  # (n, 3): x, y m and heading rad; of their joints nothing is known: at home


def render(robot: Robot, frames: list[Frame], width: int = 640, height: int = 480) -> Iterator[Array]:
    """Pictures `(height, width, 3)` uint8 of `frames`, which all show as many robots.

    Raises RenderError when there is no way to draw.
    """
    others = 0 if not frames or frames[0].robots is None else len(frames[0].robots)
    model = compiled(spec(robot, 1 + others), robot)
    model.vis.quality.offsamples = 0  # in software, smoothing costs 28 against 400 ms a picture
    model.vis.global_.offwidth, model.vis.global_.offheight = width, height
    data = mujoco.MjData(model)
    joints = [int(model.joint(name).qposadr[0]) for name in robot.names]
    try:
        renderer = mujoco.Renderer(model, height, width, max_geom=_ROOM)
    except Exception as error:  # each way of drawing raises its own kind
        raise RenderError(f"cannot draw on this machine ({error}): try MUJOCO_GL=egl or MUJOCO_GL=osmesa") from error
    with renderer:
        for flag in (mujoco.mjtRndFlag.mjRND_SHADOW, mujoco.mjtRndFlag.mjRND_REFLECTION):
            renderer.scene.flags[flag] = False
        camera = mujoco.MjvCamera()
        camera.azimuth, camera.elevation, camera.distance = AZIMUTH, ELEVATION, DISTANCE
        if frames:
            camera.lookat[:] = frames[0].place
            if frames[0].goal is not None:
                ahead = frames[0].goal - frames[0].place[:2]
                camera.azimuth = np.degrees(np.arctan2(ahead[1], ahead[0])) + ASIDE
            if others:
                places = _places(frames[0])
                camera.lookat[:2], camera.elevation = places.mean(0), ABOVE
                camera.distance = DISTANCE + ROOM * float(np.ptp(places, axis=0).max())
        trail: list[Array] = []
        for frame in frames:
            data.qpos[0:3], data.qpos[3:7], data.qpos[joints] = frame.place, frame.orientation, frame.joints
            for number in range(1, others + 1):
                _stand(model, data, robot, number, frame)
            mujoco.mj_kinematics(model, data)
            mujoco.mj_camlight(model, data)
            places = _places(frame)
            camera.lookat[:2] += FOLLOW * (places.mean(0) - camera.lookat[:2])
            renderer.update_scene(data, camera)
            if not trail or np.linalg.norm(frame.place[:2] - trail[-len(places)]) > 0.02:
                trail += list(places)
            _draw(renderer.scene, frame, trail)
            yield renderer.render()


def _places(frame: Frame) -> Array:
    """Where robots are in a frame `(n, 2)` m, the one that is shown moving first."""
    return np.vstack([frame.place[:2], *(frame.robots[:, :2] if frame.robots is not None else ())])


def _stand(model: mujoco.MjModel, data: mujoco.MjData, robot: Robot, number: int, frame: Frame) -> None:
    """Put another robot, by its number, where the frame has it."""
    assert frame.robots is not None
    x, y, heading = frame.robots[number - 1]
    joints = [int(model.joint(prefix(number) + name).qposadr[0]) for name in robot.names]
    base = number * (model.nq // (1 + len(frame.robots)))
    data.qpos[base : base + 7] = x, y, robot.standing_height, np.cos(heading / 2), 0.0, 0.0, np.sin(heading / 2)
    data.qpos[joints] = robot.home


def _draw(scene: mujoco.MjvScene, frame: Frame, trail: list[Array]) -> None:
    if frame.goal is not None:
        _add(scene, mujoco.mjtGeom.mjGEOM_CYLINDER, (0.05, 0.002, 0), frame.goal, 0.003, GOAL_COLOUR)
        _add(scene, mujoco.mjtGeom.mjGEOM_CYLINDER, (0.004, 0.12, 0), frame.goal, 0.12, GOAL_COLOUR)
    for x, y, radius in frame.pillars if frame.pillars is not None else ():
        size, half = (radius, PILLAR_HEIGHT / 2, 0.0), PILLAR_HEIGHT / 2
        _add(scene, mujoco.mjtGeom.mjGEOM_CYLINDER, size, np.array([x, y]), half, PILLAR_COLOUR)
    for x, y, radius in frame.spheres if frame.spheres is not None else ():
        _add(scene, mujoco.mjtGeom.mjGEOM_SPHERE, (radius, 0, 0), np.array([x, y]), radius, SPHERE_COLOUR)
    for point in frame.plan if frame.plan is not None else ():
        _add(scene, mujoco.mjtGeom.mjGEOM_SPHERE, (0.006, 0, 0), point, 0.012, PLAN_COLOUR)
    for point in trail[-(_ROOM // 2) :]:
        _add(scene, mujoco.mjtGeom.mjGEOM_SPHERE, (0.004, 0, 0), point, 0.004, TRAIL_COLOUR)


def _add(
    scene: mujoco.MjvScene,
    kind: mujoco.mjtGeom,
    size: tuple[float, float, float],
    place: Array,
    height: float,
    colour: tuple[float, float, float, float],
) -> None:
    if scene.ngeom >= scene.maxgeom:
        return
    mujoco.mjv_initGeom(
        scene.geoms[scene.ngeom],
        type=kind,
        size=np.array(size),
        pos=np.array([place[0], place[1], height]),
        mat=np.eye(3).ravel(),
        rgba=np.array(colour, dtype=np.float32),
    )
    scene.ngeom += 1

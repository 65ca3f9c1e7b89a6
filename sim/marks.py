"""What is drawn into a picture beside the robots: goal, paths, obstacles, pushes."""

from __future__ import annotations

import itertools
from collections.abc import Iterator
from dataclasses import dataclass, field

import mujoco
import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.world import SceneObject
from servoid.hw.geometry import rotation_matrix
from servoid.sim.objects import COLOURS, shapes
from servoid.sim.scene import PILLAR_COLOUR, PILLAR_HEIGHT, SPHERE_COLOUR

Colour = tuple[float, float, float, float]
GOAL_COLOUR = (0.15, 0.65, 0.30, 0.9)
REACH_COLOUR = (0.15, 0.65, 0.30, 0.35)
PATH_COLOUR = (0.15, 0.50, 0.30, 0.7)
TRAIL_COLOUR = (0.20, 0.35, 0.75, 0.9)
PLAN_COLOUR = (0.95, 0.55, 0.10, 0.9)
PUSH_COLOUR = (0.85, 0.10, 0.15, 1.0)
WRONG_COLOUR = (0.90, 0.10, 0.10, 0.65)
PUSH_LENGTH = 0.5  # m of the arrow for each m/s
WRONG_SIZE = 0.09  # of the base's height: larger than a servo, so that what is inside of a limb is seen
_GEOM = mujoco.mjtGeom


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
    objects: tuple[tuple[SceneObject, Array], ...] = ()  # with their poses (7,): x, y, z m, quaternion w x y z
    robots: Array | None = None  # (n, 3): x, y m and heading rad; of their joints nothing is known: at home
    reach: float | None = None  # m around the goal that count as there
    path: Array | None = None  # (n, 2) m: the way that was asked for
    push: Array | None = None  # (2,) m/s: the velocity that the base is changed by now
    wrong: tuple[tuple[float, float, float], ...] = ()  # m, from the base along its axes: places to look at
    ghosts: tuple[Frame, ...] = field(default=())  # poses to be in later


def draw(scene: mujoco.MjvScene, frame: Frame, trail: list[Array]) -> None:
    """Add the marks of a frame and the `trail` `(2,)` m of places that the robots were at, as far as there is room."""
    if frame.goal is not None:
        if frame.reach is not None:
            _add(scene, _GEOM.mjGEOM_CYLINDER, (frame.reach, 0.001, 0), frame.goal, 0.002, REACH_COLOUR)
        _add(scene, _GEOM.mjGEOM_CYLINDER, (0.015, 0.002, 0), frame.goal, 0.004, GOAL_COLOUR)
        _add(scene, _GEOM.mjGEOM_CYLINDER, (0.004, 0.12, 0), frame.goal, 0.12, GOAL_COLOUR)
    for place in frame.wrong:
        x, y, z = frame.place + rotation_matrix(frame.orientation) @ np.array(place)
        _add(scene, _GEOM.mjGEOM_SPHERE, (WRONG_SIZE * frame.place[2], 0, 0), np.array([x, y]), z, WRONG_COLOUR)
    for x, y, radius in frame.pillars if frame.pillars is not None else ():
        size, half = (radius, PILLAR_HEIGHT / 2, 0.0), PILLAR_HEIGHT / 2
        _add(scene, _GEOM.mjGEOM_CYLINDER, size, np.array([x, y]), half, PILLAR_COLOUR)
    for x, y, radius in frame.spheres if frame.spheres is not None else ():
        _add(scene, _GEOM.mjGEOM_SPHERE, (radius, 0, 0), np.array([x, y]), radius, SPHERE_COLOUR)
    for thing, pose in frame.objects:
        _put(scene, thing, pose)
    if frame.push is not None:  # it ends where it pushes
        tip = frame.place + np.array([0.0, 0.0, 0.08])
        tail = tip - PUSH_LENGTH * np.array([*frame.push, 0.0])
        _connect(scene, _GEOM.mjGEOM_ARROW, 0.012, tail, tip, PUSH_COLOUR)
    for start, end in _legs(frame.path):
        _connect(scene, _GEOM.mjGEOM_CAPSULE, 0.004, start, end, PATH_COLOUR)
    for point in frame.plan if frame.plan is not None else ():
        _add(scene, _GEOM.mjGEOM_SPHERE, (0.006, 0, 0), point, 0.012, PLAN_COLOUR)
    for point in trail[-(scene.maxgeom // 2) :]:
        _add(scene, _GEOM.mjGEOM_SPHERE, (0.004, 0, 0), point, 0.004, TRAIL_COLOUR)


def _legs(path: Array | None, length: float = 0.04) -> Iterator[tuple[Array, Array]]:
    """Straight pieces of a path, about so long [m], a little above the ground."""
    if path is None or len(path) < 2:
        return
    along = np.concatenate([[0.0], np.cumsum(np.linalg.norm(np.diff(path, axis=0), axis=1))])
    stops = np.linspace(0.0, along[-1], max(int(along[-1] / length), 1) + 1)
    points = np.stack([np.interp(stops, along, path[:, axis]) for axis in (0, 1)] + [np.full(len(stops), 0.004)], -1)
    yield from itertools.pairwise(points)


def _connect(
    scene: mujoco.MjvScene, kind: mujoco.mjtGeom, width: float, start: Array, end: Array, colour: Colour
) -> None:
    if scene.ngeom < scene.maxgeom:
        geom = scene.geoms[scene.ngeom]
        mujoco.mjv_initGeom(geom, kind, np.zeros(3), np.zeros(3), np.eye(3).ravel(), np.array(colour, dtype=np.float32))
        mujoco.mjv_connector(geom, kind, width, np.asarray(start, dtype=float), np.asarray(end, dtype=float))
        scene.ngeom += 1


def _put(scene: mujoco.MjvScene, thing: SceneObject, pose: Array) -> None:
    """Add an object in its pose."""
    turn = np.zeros(9)
    mujoco.mju_quat2Mat(turn, np.asarray(pose[3:], dtype=float))
    for kind, size, place in shapes(thing):
        if scene.ngeom < scene.maxgeom:
            mujoco.mjv_initGeom(
                scene.geoms[scene.ngeom],
                type=kind,
                size=np.array(size, dtype=float),
                pos=np.asarray(pose[:3], dtype=float) + turn.reshape(3, 3) @ np.array(place),
                mat=turn,
                rgba=np.array(COLOURS[thing.kind], dtype=np.float32),
            )
            scene.ngeom += 1


def _add(
    scene: mujoco.MjvScene,
    kind: mujoco.mjtGeom,
    size: tuple[float, float, float],
    place: Array,
    height: float,
    colour: Colour,
) -> None:
    if scene.ngeom < scene.maxgeom:
        mujoco.mjv_initGeom(
            scene.geoms[scene.ngeom],
            type=kind,
            size=np.array(size),
            pos=np.array([place[0], place[1], height]),
            mat=np.eye(3).ravel(),
            rgba=np.array(colour, dtype=np.float32),
        )
        scene.ngeom += 1

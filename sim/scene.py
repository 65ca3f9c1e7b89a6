"""The scene of a task in a MuJoCo model, and what a robot sees of it."""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import asdict
from typing import Any

import mujoco
import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import State
from servoid.hw.contracts.world import Percept, Scene, SceneObject, Truth
from servoid.hw.geometry import headed
from servoid.sim.multi_robot import ADDED, prefix
from servoid.sim.objects import add_object

SCENE = f"{ADDED}scene/"  # of the names of a scene's bodies, which follow the robot's
OBJECTS = f"{SCENE}object"  # and a number
PILLAR_HEIGHT = 0.4  # m: taller than the robot's shoulders
PILLAR_COLOUR, SPHERE_COLOUR = (0.55, 0.42, 0.32, 1.0), (0.80, 0.20, 0.20, 1.0)
FOUND = 1  # data bit of MuJoCo's contact sensor


def add_scene(model: mujoco.MjSpec, scene: Scene) -> None:
    """Add static pillars, mocap spheres and objects, and a contact sensor for pillars, spheres and bars.

    Like the floor, they meet all that collides with the floor.
    """
    bodies = []
    if len(scene.pillars):
        bodies.append(model.worldbody.add_body(name=f"{SCENE}pillars"))
        for x, y, radius in scene.pillars:
            _add_geom(bodies[0], mujoco.mjtGeom.mjGEOM_CYLINDER, [radius, PILLAR_HEIGHT / 2, 0], PILLAR_COLOUR, [x, y])
    for number, (x, y, radius, _) in enumerate(scene.spheres):
        body = model.worldbody.add_body(name=f"{SCENE}sphere{number}", mocap=True, pos=[x, y, radius])
        _add_geom(body, mujoco.mjtGeom.mjGEOM_SPHERE, [radius, 0, 0], SPHERE_COLOUR)
        bodies.append(body)
    for number, thing in enumerate(scene.objects):
        add_object(model, f"{OBJECTS}{number}", thing)
    felt = [body.name for body in bodies]
    felt += [f"{OBJECTS}{number}" for number, thing in enumerate(scene.objects) if thing.kind == "bar"]
    for name in felt:
        model.add_sensor(
            name=name,
            type=mujoco.mjtSensor.mjSENS_CONTACT,
            objtype=mujoco.mjtObj.mjOBJ_BODY,
            objname=name,
            intprm=[FOUND, 0, 1],
        )


def _add_geom(
    body: Any, kind: mujoco.mjtGeom, size: list[float], colour: tuple[float, ...], at: Sequence[float] = (0.0, 0.0)
) -> None:
    height = size[1] if kind == mujoco.mjtGeom.mjGEOM_CYLINDER else 0.0
    body.add_geom(
        type=kind, size=size, pos=[*at, height], rgba=colour, contype=1, conaffinity=1, condim=3, solref=[0.008, 1.0]
    )


def count_robots(scene: Scene | None) -> int:
    """How many robots are in a world with this scene."""
    return 1 if scene is None or scene.robots is None else 1 + len(scene.robots)


def robot_bodies(model: mujoco.MjModel) -> int:
    """How many of a model's bodies, the first ones, are the world's and the first robot's, and not a scene's."""
    return next((i for i in range(model.nbody) if model.body(i).name.startswith((SCENE, prefix(1)))), model.nbody)


def scene_sensors(model: mujoco.MjModel) -> Array:
    """Addresses of the scene's contact sensors in the sensor data."""
    sensors = (model.sensor(i) for i in range(model.nsensor))
    return np.array([int(s.adr[0]) for s in sensors if s.name.startswith(SCENE)], dtype=int)


def plain(scene: Scene) -> dict[str, Any]:
    """A scene as JSON values. Raises ValueError for one of several robots."""
    if scene.robots is not None:
        raise ValueError("a virtual rig has one robot, and this scene has others")
    goal = None if scene.goal is None else scene.goal.tolist()
    objects = [asdict(thing) for thing in scene.objects]
    return {"pillars": scene.pillars.tolist(), "spheres": scene.spheres.tolist(), "goal": goal, "objects": objects}


def from_plain(values: dict[str, Any]) -> Scene:
    """The scene that `plain` wrote."""
    return Scene(
        np.array(values["pillars"], dtype=float).reshape(-1, 3),
        np.array(values["spheres"], dtype=float).reshape(-1, 4),
        None if values["goal"] is None else np.array(values["goal"], dtype=float),
        objects=tuple(
            SceneObject(**{**each, "place": tuple(each["place"]), "size": tuple(each["size"])})
            for each in values["objects"]
        ),
    )


class Stage:
    """A scene in play, as one of its robots sees it: by default the first, whom spheres pursue.

    `move` puts the spheres' centres `(m, 3)` m into the world, before time goes on.
    """

    def __init__(self, scene: Scene, truth: Truth, dt: float, move: Callable[[Array], None], robot: int = 0) -> None:
        self.scene = scene
        self._truth, self._dt, self._move, self._robot = truth, dt, move, robot
        self._goal = scene.goal if robot == 0 or scene.robots is None else scene.robots[robot - 1, 3:]
        self._spheres = scene.spheres[:, :2].copy()

    @property
    def obstacles(self) -> Array:
        """Pillars and spheres as they are now `(n, 3)` m: x, y, radius, world frame."""
        return np.concatenate([self.scene.pillars, np.column_stack([self._spheres, self.scene.spheres[:, 2]])])

    def look(self, state: State) -> Percept:
        """What is seen, in the odometry frame of `state`: right relative to the robot, wherever it believes to be."""
        base, yaw = self._truth.position[self._robot, :2].copy(), float(self._truth.yaw[self._robot])
        obstacles = self.obstacles
        obstacles[:, :2] = _seen(obstacles[:, :2], base, yaw, state)
        goal = None if self._goal is None else _seen(self._goal[None], base, yaw, state)[0]
        robots = None
        if self.scene.robots is not None:
            others = np.arange(len(self.scene.robots) + 1) != self._robot
            places = _seen(self._truth.position[others, :2], base, yaw, state)
            robots = np.column_stack([places, self._truth.yaw[others] + float(state.yaw) - yaw])
        objects = None
        if self.scene.objects:
            objects = self._truth.objects[self._robot].copy()
            objects[:, :2] = _seen(objects[:, :2], base, yaw, state)
            objects[:, 3:] = headed(objects[:, 3:], np.full(len(objects), float(state.yaw) - yaw))
        if len(self._spheres):
            self._pursue(base)
        return Percept(source="scene", age=0.0, goal=goal, obstacles=obstacles, robots=robots, objects=objects)

    def _pursue(self, base: Array) -> None:
        """Let the spheres roll toward the robot for a tick."""
        way = base - self._spheres
        distance = np.linalg.norm(way, axis=1, keepdims=True)
        step = np.minimum(self.scene.spheres[:, 3:] * self._dt, distance)
        self._spheres = self._spheres + step * way / np.maximum(distance, 1e-9)
        self._move(np.column_stack([self._spheres, self.scene.spheres[:, 2]]))


def _seen(places: Array, base: Array, yaw: float, state: State) -> Array:
    """World places `(n, 2)` m in the odometry frame of `state`, seen from the true base."""
    turn = float(state.yaw) - yaw
    cos, sin = np.cos(turn), np.sin(turn)
    return (places - base) @ np.array([[cos, sin], [-sin, cos]]) + state.displacement[:2]

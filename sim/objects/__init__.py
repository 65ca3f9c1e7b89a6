"""Things in a MuJoCo model: balls that roll, bags that stand and fall, and seats, which are fixed to the floor."""

from __future__ import annotations

import math
from typing import Any

import mujoco
import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.world import SceneObject

COLOURS = {
    "ball": (0.95, 0.55, 0.10, 1.0), "bag": (0.35, 0.30, 0.65, 1.0), "seat": (0.55, 0.42, 0.32, 1.0),
    "bar": (0.80, 0.20, 0.20, 1.0), "box": (0.76, 0.60, 0.40, 1.0), "target": (0.15, 0.65, 0.30, 0.8),
}  # fmt: skip
POSE, RATE = 7, 6  # numbers of a free body's pose and velocity
_FREE = mujoco.mjtJoint.mjJNT_FREE
_PLATE = 0.03  # m, of a seat
_GRIP = (1.0, 0.01, 0.0001)  # sliding, and m of turning about the contact's normal, as of a pad of 15 mm
_ROLLING = 0.0005  # m: a ball of 0.07 m slows down by 0.1 m/s2


def shapes(thing: SceneObject) -> list[tuple[mujoco.mjtGeom, list[float], list[float]]]:
    """Kind, half sizes [m] and place in its own frame [m] of each of an object's geoms.

    A seat is a plate with a block under its rear half: as under any chair, there is room for the heels.
    """
    x, y, z = (part / 2 for part in thing.size)
    if thing.round:
        return [(mujoco.mjtGeom.mjGEOM_SPHERE, [x, 0, 0], [0.0, 0.0, 0.0])]
    box = mujoco.mjtGeom.mjGEOM_BOX
    if thing.kind != "seat":
        return [(box, [x, y, z], [0.0, 0.0, 0.0])]
    plate = min(_PLATE / 2, z)
    return [(box, [x, y, plate], [0.0, 0.0, z - plate]), (box, [x / 2, y, z], [-x / 2, 0.0, 0.0])]


def pose(thing: SceneObject) -> Array:
    """Where an object stands as the scene has it `(7,)`: x, y, z m of the middle, quaternion w x y z."""
    half = thing.heading / 2
    return np.array([*thing.place, thing.height, math.cos(half), 0.0, 0.0, math.sin(half)])


def add_object(model: mujoco.MjSpec, name: str, thing: SceneObject) -> None:
    """Add an object under a name. It meets all that collides with the floor, and other objects."""
    at = pose(thing)
    body = model.worldbody.add_body(name=name, pos=at[:3], quat=at[3:])
    more: dict[str, Any] = {"mass": thing.mass} if thing.movable else {}
    if thing.kind == "ball":  # rolling friction counts in contacts of six dimensions, and against the floor's own
        more |= {"condim": 6, "priority": 2, "friction": [0.8, 0.005, _ROLLING]}
    if thing.kind == "box":  # between soft hands, which stick rather than slip; stiff, or it would creep out of them
        more |= {"condim": 4, "priority": 2, "friction": list(_GRIP), "solimp": [0.98, 0.999, 0.001, 0.5, 2.0]}
    if thing.movable:
        body.add_freejoint(name=name)
    meets = int(thing.kind != "target")
    for kind, size, place in shapes(thing):
        body.add_geom(
            type=kind,
            size=size,
            pos=place,
            rgba=COLOURS[thing.kind],
            contype=meets,
            conaffinity=meets,
            solref=[0.008, 1.0],
            **more,
        )


class ObjectsOf:
    """Where the objects of a model's scene are in its arrays. `movable` says which of them are free bodies."""

    def __init__(self, model: mujoco.MjModel, beginning: str) -> None:
        """`beginning` is that of their bodies' names."""
        bodies = [model.body(i) for i in range(model.nbody) if model.body(i).name.startswith(beginning)]
        joints = [model.joint(int(body.jntadr[0])) if body.jntnum[0] else None for body in bodies]
        self.movable = np.array([joint is not None for joint in joints], dtype=bool)
        free = [joint for joint in joints if joint is not None]
        self.qpos = _columns([int(joint.qposadr[0]) for joint in free], POSE)
        self.qvel = _columns([int(joint.dofadr[0]) for joint in free], RATE)
        self.begin = model.qpos0[self.qpos]  # (movable objects, 7)
        self._fixed = np.array([[*body.pos, *body.quat] for body in bodies]).reshape(-1, POSE)

    def poses(self, qpos: Array) -> Array:
        """Poses `(n, objects, 7)` in worlds of generalised positions `(n, nq)`."""
        poses = np.repeat(self._fixed[None], len(qpos), 0)
        poses[:, self.movable] = qpos[:, self.qpos]
        return poses

    def put(self, qpos: Array, qvel: Array, ids: Array, poses: Array) -> None:
        """Write poses `(k, movable objects, 7)` of the worlds `ids`, at rest, into bound arrays of a batch."""
        if not len(self.qpos):
            return
        qpos[ids[:, None, None], self.qpos] = poses
        qvel[ids[:, None, None], self.qvel] = 0.0


def _columns(starts: list[int], width: int) -> Array:
    return np.array(starts, dtype=int)[:, None] + np.arange(width)

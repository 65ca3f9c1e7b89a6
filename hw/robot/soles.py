"""The sole of a foot, from the collision geoms that touch the ground."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import product
from typing import TYPE_CHECKING

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import rotation_matrix

if TYPE_CHECKING:
    import mujoco

_UPRIGHT = np.cos(np.deg2rad(35.0))  # of a face that may be a sole, at the home pose: not every robot stands level
_FORWARD = np.cos(np.deg2rad(45.0))
_FLAT = 0.004  # m above the lowest point that still counts as sole: rounded edges, and soles of several parts
_LARGER = 1.5  # times the area by which a sole must be larger to be taken instead
_LEAST = 0.004  # m, half size of a sole that touches in a point or a line


@dataclass(frozen=True)
class Sole:
    """A sole in its body's frame: centre `(3,)` m, half length and width `(2,)` m, and its axes as columns `(3, 3)`:
    x forward, y left, z up."""

    centre: Array
    half_size: Array
    turn: Array


def find_sole(model: mujoco.MjModel, geoms: tuple[str, ...], home: Array) -> Sole:
    """The sole of `geoms`, all fixed to the body of the first; `home` `(3, 3)` turns that body into the base at the
    home pose, where soles lie about level.

    Its axes are the body's, those of one of its boxes, or the base's at home: of those that are about level at home the
    first, unless along others a clearly larger sole touches the ground at once.
    """
    ids = [model.geom(name).id for name in geoms]
    first = int(model.geom_bodyid[ids[0]])
    frames, points = [np.eye(3)], []
    for geom in ids:
        place, turn = _in_body(model, geom, first)
        if int(model.geom_type[geom]) == _box():
            frames.append(turn)
        points.append(place + _points(model, geom, turn.T @ -home[2]) @ turn.T)
    levels = [axes for axes in (_axes(frame, home) for frame in frames) if axes is not None]
    soles = [_touching(np.concatenate(points), level) for level in [*levels, home.T]]
    best = soles[0]
    for sole in soles[1:]:
        best = sole if np.prod(sole.half_size) > _LARGER * np.prod(best.half_size) else best
    return best


def _touching(points: Array, level: Array) -> Sole:
    """The sole that the lowest of points `(n, 3)` m are along the axes that are the columns of `level`."""
    cloud = points @ level
    under = cloud[cloud[:, 2] < cloud[:, 2].min() + _FLAT]
    low, high = under.min(0), under.max(0)
    centre = np.array([*(low[:2] + high[:2]) / 2, low[2]])
    return Sole(level @ centre, np.maximum((high - low)[:2] / 2, _LEAST), level)


def _axes(frame: Array, home: Array) -> Array | None:
    """The columns of `frame`, ordered and signed to be forward, left and up at home; None if none is about up."""
    ups, forwards = home[2] @ frame, home[0] @ frame  # of each column
    z = int(np.abs(ups).argmax())
    if abs(ups[z]) < _UPRIGHT:
        return None
    x = max((i for i in range(3) if i != z), key=lambda i: abs(forwards[i]))
    if abs(forwards[x]) < _FORWARD:
        return None
    up, forward = np.sign(ups[z]) * frame[:, z], np.sign(forwards[x]) * frame[:, x]
    left = np.cross(up, forward)
    return np.stack([forward, left, up], -1) + 0.0  # no negative zeros


def _in_body(model: mujoco.MjModel, geom: int, body: int) -> tuple[Array, Array]:
    """Place and turn of a geom in the frame of a body that it is fixed to, maybe over other bodies."""
    place, turn = model.geom_pos[geom].copy(), rotation_matrix(model.geom_quat[geom])
    up, own = _to_weld(model, int(model.geom_bodyid[geom])), _to_weld(model, body)
    if int(model.geom_bodyid[geom]) == body:
        return place, turn
    place, turn = up[0] + up[1] @ place, up[1] @ turn  # in the body that all of them are fixed to
    return own[1].T @ (place - own[0]), own[1].T @ turn


def _to_weld(model: mujoco.MjModel, body: int) -> tuple[Array, Array]:
    place, turn = np.zeros(3), np.eye(3)
    while body != int(model.body_weldid[body]):
        step = rotation_matrix(model.body_quat[body])
        place, turn = model.body_pos[body] + step @ place, step @ turn
        body = int(model.body_parentid[body])
    return place, turn


def _points(model: mujoco.MjModel, geom: int, down: Array) -> Array:
    """Points `(n, 3)` of a geom, in its own frame, that hold all that may touch the ground when `down` is down."""
    import mujoco

    kind, size = mujoco.mjtGeom(int(model.geom_type[geom])), model.geom_size[geom]
    ends = np.array(list(product((-1.0, 1.0), repeat=3)))
    if kind == mujoco.mjtGeom.mjGEOM_BOX:
        return ends * size
    if kind == mujoco.mjtGeom.mjGEOM_SPHERE:
        return size[0] * down[None]
    if kind == mujoco.mjtGeom.mjGEOM_CAPSULE:
        return np.array([[0.0, 0.0, -size[1]], [0.0, 0.0, size[1]]]) + size[0] * down
    if kind == mujoco.mjtGeom.mjGEOM_CYLINDER:
        around = np.linspace(0.0, 2 * np.pi, 33)[:-1]
        ring = np.stack([np.cos(around), np.sin(around)], -1) * size[0]
        return np.concatenate([np.column_stack([ring, np.full(32, z)]) for z in (-size[1], size[1])])
    if kind == mujoco.mjtGeom.mjGEOM_ELLIPSOID:
        return (size**2 * down / np.linalg.norm(size * down))[None]
    if kind == mujoco.mjtGeom.mjGEOM_MESH:
        mesh = int(model.geom_dataid[geom])
        start = int(model.mesh_vertadr[mesh])
        return np.asarray(model.mesh_vert[start : start + int(model.mesh_vertnum[mesh])], float)
    return np.zeros((1, 3))


def _box() -> int:
    import mujoco

    return int(mujoco.mjtGeom.mjGEOM_BOX)

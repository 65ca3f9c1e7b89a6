"""Where a body meets the ground, in any pose: on its back as well as on its feet."""

from __future__ import annotations

from collections.abc import Iterable, Iterator

import mujoco
import numpy as np

from servoid.hw.contracts.body import Array
from servoid.sim.model import FLOOR
from servoid.sim.scene import robot_bodies

_GEOM = mujoco.mjtGeom
_NEAR = 0.002  # m: what is not higher touches the ground; what a body stands on sinks in a little


class Ground:
    """Finds the lowest point of what the first robot of a model collides with the floor by."""

    def __init__(self, model: mujoco.MjModel) -> None:
        self._model, self._data = model, mujoco.MjData(model)
        floor, bodies = model.geom(FLOOR), robot_bodies(model)
        meets = (model.geom_contype & floor.conaffinity) | (model.geom_conaffinity & floor.contype)
        own = (model.geom_bodyid > 0) & (model.geom_bodyid < bodies)
        self._geoms = np.flatnonzero((meets != 0) & own)

    def height(self, qpos: Array) -> float:
        """Height [m] of the base at which a body of generalised positions `(nq,)` touches the ground.

        What `qpos` says of the height is left out. Exact for all shapes but height fields, which are taken for boxes.
        """
        self._data.qpos[: len(qpos)] = qpos
        self._data.qpos[2] = 0.0
        mujoco.mj_kinematics(self._model, self._data)
        return -min(self._lowest(int(geom)) for geom in self._geoms)

    def touched_by(self, qpos: Array, apart_from: Iterable[str] = ()) -> list[str]:
        """Names of the bodies that touch the ground in a pose of generalised positions `(nq,)`, `apart_from` those
        that carry these geoms, and what hangs on them."""
        model = self._model
        self._data.qpos[: len(qpos)] = qpos
        mujoco.mj_kinematics(model, self._data)
        parents = {int(model.body_weldid[model.geom(name).bodyid[0]]) for name in apart_from}
        touching = {int(model.geom_bodyid[g]) for g in self._geoms if self._lowest(int(g)) < _NEAR}
        return [model.body(body).name for body in sorted(touching) if parents.isdisjoint(self._line(body))]

    def _line(self, body: int) -> Iterator[int]:
        """A body and those that it hangs on, one after the other."""
        while body:
            yield body
            body = int(self._model.body_parentid[body])

    def _lowest(self, geom: int) -> float:
        """Height of a geom's lowest point."""
        model = self._model
        size, axes = model.geom_size[geom], self._data.geom_xmat[geom, 6:9]  # how much its axes point up
        middle = float(self._data.geom_xpos[geom, 2])
        match model.geom_type[geom]:
            case _GEOM.mjGEOM_SPHERE:
                return middle - float(size[0])
            case _GEOM.mjGEOM_CAPSULE:
                return middle - float(size[0] + size[1] * abs(axes[2]))
            case _GEOM.mjGEOM_CYLINDER:
                return middle - float(size[0] * np.hypot(axes[0], axes[1]) + size[1] * abs(axes[2]))
            case _GEOM.mjGEOM_BOX:
                return middle - float(np.abs(axes) @ size)
            case _GEOM.mjGEOM_ELLIPSOID:
                return middle - float(np.linalg.norm(axes * size))
            case _GEOM.mjGEOM_MESH:
                mesh = model.geom_dataid[geom]
                first, count = model.mesh_vertadr[mesh], model.mesh_vertnum[mesh]
                return middle + float((model.mesh_vert[first : first + count] @ axes).min())
        box = model.geom_aabb[geom]
        return middle + float(axes @ box[:3] - np.abs(axes) @ box[3:])

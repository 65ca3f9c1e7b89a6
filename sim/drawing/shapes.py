"""A robot's shapes for whoever draws them: the meshes and boxes of its MuJoCo model, and where its bodies are."""

from __future__ import annotations

from dataclasses import dataclass

import mujoco
import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.hw.robot.mjcf import compiled
from servoid.sim.model import spec
from servoid.sim.multi_robot import ADDED

_GEOM = mujoco.mjtGeom


@dataclass(frozen=True)
class BodyShape:
    """Something that hangs on a body. `kind` is box, sphere, ellipsoid, cylinder, capsule or mesh."""

    body: str
    kind: str
    size: Array  # (3,) m, as MuJoCo's geoms have it: half sizes; radius and half length; radius
    position: Array  # (3,) m in the body's frame
    orientation: Array  # (4,) quaternion w x y z
    colour: Array  # (4,) 0..1
    vertices: Array | None = None  # (n, 3) m of a mesh
    faces: Array | None = None  # (m, 3) int


class Figure:
    """A robot that is put into poses, for its picture alone. Raises ConfigError where its model cannot be compiled."""

    def __init__(self, robot: Robot) -> None:
        self._robot = robot
        self._model = compiled(spec(robot), robot.mjcf)
        self._data = mujoco.MjData(self._model)
        model = self._model
        self._joints = [int(model.joint(name).qposadr[0]) for name in robot.names]
        self.bodies = tuple(model.body(i).name for i in range(1, model.nbody))
        self.shapes = tuple(self._shape(i) for i in range(model.ngeom) if self._is_seen(i))
        self._soles = [int(model.site(f"{ADDED}{name}_foot").id) for name in robot.feet]

    def pose(self, place: Array, orientation: Array, joints: Array) -> tuple[Array, Array]:
        """Where each body is `(bodies, 3)` m, and how it is turned `(bodies, 4)` w x y z, with the base at `place`.

        A joint that was not read is drawn at its home.
        """
        data = self._data
        data.qpos[:3], data.qpos[3:7] = place, orientation
        data.qpos[self._joints] = np.where(np.isfinite(joints), joints, self._robot.home)
        mujoco.mj_kinematics(self._model, data)
        return data.xpos[1:].copy(), data.xquat[1:].copy()

    @property
    def soles(self) -> Array:
        """Where the soles are in the pose that it was put into last `(n_feet, 3)` m."""
        return self._data.site_xpos[self._soles].copy()

    def _is_seen(self, number: int) -> bool:
        """Whether a picture shows a geom: of MuJoCo's groups it shows the first three, and no plane."""
        model = self._model
        return (
            model.geom_bodyid[number] > 0
            and model.geom_group[number] < 3
            and model.geom_type[number] in _NAMES
            and self._colour(number)[3] > 0.0
        )

    def _colour(self, number: int) -> Array:
        model = self._model
        material = int(model.geom_matid[number])
        colour = model.mat_rgba[material] if material >= 0 else model.geom_rgba[number]
        return np.array(colour, dtype=float)

    def _shape(self, number: int) -> BodyShape:
        model = self._model
        kind = _NAMES[int(model.geom_type[number])]
        vertices = faces = None
        if kind == "mesh":
            mesh = int(model.geom_dataid[number])
            first, count = int(model.mesh_vertadr[mesh]), int(model.mesh_vertnum[mesh])
            vertices = model.mesh_vert[first : first + count].copy()
            first, count = int(model.mesh_faceadr[mesh]), int(model.mesh_facenum[mesh])
            faces = model.mesh_face[first : first + count].copy()
        return BodyShape(
            body=model.body(int(model.geom_bodyid[number])).name,
            kind=kind,
            size=model.geom_size[number].copy(),
            position=model.geom_pos[number].copy(),
            orientation=model.geom_quat[number].copy(),
            colour=self._colour(number),
            vertices=vertices,
            faces=faces,
        )


_NAMES = {
    int(_GEOM.mjGEOM_BOX): "box",
    int(_GEOM.mjGEOM_SPHERE): "sphere",
    int(_GEOM.mjGEOM_ELLIPSOID): "ellipsoid",
    int(_GEOM.mjGEOM_CYLINDER): "cylinder",
    int(_GEOM.mjGEOM_CAPSULE): "capsule",
    int(_GEOM.mjGEOM_MESH): "mesh",
}

"""What still poses of a robot mean, by its model: where its mass is, what its servos hold, and how a limb reaches."""

from __future__ import annotations

import mujoco
import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.sim.model import build

_STEP = 0.5  # rad, of a joint's correction at most
_DAMPING = 1e-4  # m2, of the least squares
_REACHES = 200  # corrections


class Statics:
    """Of poses: joints `(ticks, n_joints)` rad, and place `(ticks, 3)` m and quaternion `(ticks, 4)` of the base."""

    def __init__(self, robot: Robot) -> None:
        self.robot, self.model = robot, build(robot)
        self.data = mujoco.MjData(self.model)
        ids = [self.model.joint(name).id for name in robot.names]
        self._at, self._dof = self.model.jnt_qposadr[ids], self.model.jnt_dofadr[ids]
        self._base = self.model.body(robot.base).id
        self._weight = float(self.model.body_subtreemass[self._base] * -self.model.opt.gravity[2])  # N
        self._ankles = [int(self.model.geom(foot.geoms[0]).bodyid[0]) for foot in robot.feet.values()]
        self.geoms = [name for i in range(self.model.ngeom) if (name := self.model.geom(i).name)]

    def centre(self, joints: Array, place: Array, turn: Array) -> Array:
        """Centre of mass on the ground `(ticks, 2)` m."""
        out = np.empty((len(joints), 2))
        for i in range(len(joints)):
            self._set(joints[i], place[i], turn[i])
            out[i] = self.data.subtree_com[self._base, :2]
        return out

    def torque(self, joints: Array, place: Array, turn: Array, points: Array, share: Array) -> Array:
        """What the servos hold `(ticks, n_joints)` N m where each foot carries its `share` `(ticks, n_feet)` of the
        weight at one of `points` `(ticks, n_feet, 3)` m, pushed straight up."""
        out = np.empty_like(joints)
        jacobian, force = np.zeros((3, self.model.nv)), np.zeros(self.model.nv)
        self.data.qvel[:] = 0.0
        for i in range(len(joints)):
            self._set(joints[i], place[i], turn[i])
            mujoco.mj_comVel(self.model, self.data)
            mujoco.mj_rne(self.model, self.data, 0, force)
            for body, part, point in zip(self._ankles, share[i], points[i], strict=True):
                mujoco.mj_jac(self.model, self.data, jacobian, None, point, body)
                force -= jacobian[2] * part * self._weight
            out[i] = force[self._dof]
        return out

    def reach(self, geom: str, target: Array, joints: Array) -> tuple[Array, float]:
        """Joints `(n_joints,)` with the limb that holds `geom` bent, so that it is at `target` `(3,)` m seen from the
        base; and by how much it misses, m.

        Damped least squares: C. W. Wampler, IEEE Trans. Systems, Man and Cybernetics 16 (1986) 93.
        """
        joints = joints.copy()
        chain = self._chain(int(self.model.geom(geom).bodyid[0]))
        jacobian = np.zeros((3, self.model.nv))
        margin = self.robot.limits.margin
        low, high = self.robot.lower[chain] + margin, self.robot.upper[chain] - margin
        for _ in range(_REACHES):
            error = target - self.place(geom, joints)
            mujoco.mj_jacGeom(self.model, self.data, jacobian, None, self.model.geom(geom).id)
            j = jacobian[:, self._dof[chain]]
            step = j.T @ np.linalg.solve(j @ j.T + _DAMPING * np.eye(3), error)
            joints[chain] = np.clip(joints[chain] + np.clip(step, -_STEP, _STEP), low, high)
        return joints, float(np.linalg.norm(target - self.place(geom, joints)))

    def place(self, geom: str, joints: Array) -> Array:
        """Where a geom is `(3,)` m seen from the base, in the pose `(n_joints,)`."""
        self._set(joints, np.zeros(3), np.array([1.0, 0.0, 0.0, 0.0]))
        return np.array(self.data.geom(geom).xpos)

    def _set(self, joints: Array, place: Array, turn: Array) -> None:
        self.data.qpos[:3], self.data.qpos[3:7], self.data.qpos[self._at] = place, turn, joints
        mujoco.mj_kinematics(self.model, self.data)
        mujoco.mj_comPos(self.model, self.data)

    def _chain(self, body: int) -> list[int]:
        """Joints between a body and the base."""
        owner = {int(self.model.jnt_bodyid[self.model.joint(name).id]): i for i, name in enumerate(self.robot.names)}
        found = []
        while body not in (self._base, 0):
            if body in owner:
                found.append(owner[body])
            body = int(self.model.body_parentid[body])
        return found

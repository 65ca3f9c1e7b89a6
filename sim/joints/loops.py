"""Passive joints of closed loops: where the constraints that tie them to the servos' joints have them."""

from __future__ import annotations

import mujoco
import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot

_WAY, _STEPS = 6, 10  # poses on the way from that of the MJCF, in which loops are closed, and Newton's steps in each
_CLOSED = 1e-6  # m or rad that a loop may stand open
_LONGEST = 0.3  # rad that a joint goes in a step


class Loops:
    """Puts a robot's passive joints where its loops are closed, so that a body that is placed does not jerk."""

    def __init__(self, model: mujoco.MjModel, robot: Robot) -> None:
        joints = [model.joint(name) for name in robot.passive]
        self._hinges = [joint for joint in joints if joint.type[0] != mujoco.mjtJoint.mjJNT_BALL]
        self.any = bool(model.neq and self._hinges)
        self._model, self._data = model, mujoco.MjData(model)
        self._qpos = np.array([int(joint.qposadr[0]) for joint in self._hinges], dtype=int)
        self._driven = np.array([int(model.joint(name).qposadr[0]) for name in robot.names])
        self._dofs = np.array([int(joint.dofadr[0]) for joint in self._hinges], dtype=int)

    def close(self, qpos: Array) -> None:
        """Turn the passive joints of generalised positions `(nq,)`, in place; as near as they get where the loops do
        not close in that pose."""
        if not self.any:
            return
        model, data = self._model, self._data
        data.qpos[:] = model.qpos0
        for share in np.linspace(0.0, 1.0, _WAY + 1)[1:]:
            data.qpos[self._driven] = share * qpos[self._driven]
            for _ in range(_STEPS):
                mujoco.mj_fwdPosition(model, data)
                rows = data.efc_type == mujoco.mjtConstraint.mjCNSTR_EQUALITY
                gap = data.efc_pos[rows]
                if not len(gap) or np.abs(gap).max() < _CLOSED:
                    break
                jacobian = _jacobian(model, data)[rows][:, self._dofs]
                step = np.linalg.lstsq(jacobian, -gap, rcond=1e-6)[0]
                data.qpos[self._qpos] += np.clip(step, -_LONGEST, _LONGEST)
        qpos[self._qpos] = data.qpos[self._qpos]


def _jacobian(model: mujoco.MjModel, data: mujoco.MjData) -> Array:
    """Of the constraints `(nefc, nv)`, which MuJoCo keeps sparse where a model asks for that or is large."""
    if not mujoco.mj_isSparse(model):
        dense: Array = data.efc_J.reshape(-1, model.nv)
        return dense
    full = np.zeros((data.nefc, model.nv))
    mujoco.mju_sparse2dense(full, data.efc_J, data.efc_J_rownnz, data.efc_J_rowadr, data.efc_J_colind)
    return full

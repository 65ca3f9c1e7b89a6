"""A model that hangs on another body moves as it did."""

from __future__ import annotations

from pathlib import Path

import mujoco
import numpy as np
import pytest

from servoid.hw.robot.mjcf import read_spec

MODEL = """<mujoco><compiler angle="radian"/><default><default class="limb"><joint armature="0.02"/></default></default>
<worldbody><body name="pelvis" pos="0 0 1" childclass="limb"><freejoint name="root"/><geom size="0.1"/>
<body name="leg" pos="0.1 0.1 -0.1" quat="0.9 0.1 0.3 0.2"><joint name="hip" axis="0 1 1" pos="0 0.01 0"/>
<geom size="0.05"/></body>
<body name="spine" pos="0.02 0.01 0.3" quat="0.7 0.1 0.5 0.4"><joint name="waist" axis="1 2 3" pos="0.01 0 0.02"/>
<joint name="sway" axis="0 1 0" pos="0 0 0.05"/><geom size="0.05"/>
<body name="torso" pos="0 0.03 0.2" quat="0.2 0.4 0.8 0.1"><joint name="lean" axis="1 0 0"/><geom size="0.1"/>
<site name="imu"/><body name="arm" pos="0 0.2 0"><joint name="shoulder" axis="0 0 1" class="main"/><geom size="0.03"/>
</body></body></body></body></worldbody>
<keyframe><key name="bent" qpos="0 0 1 1 0 0 0 0.1 0.2 0.3 0.4 0.5"/></keyframe></mujoco>"""


def places(model: mujoco.MjModel, angles: dict[str, float], seen_from: str) -> dict[str, np.ndarray]:
    """Where the bodies are and how they are turned, in the frame of one of them."""
    data = mujoco.MjData(model)
    for name, angle in angles.items():
        data.joint(name).qpos = angle
    mujoco.mj_kinematics(model, data)
    base = data.body(seen_from)
    turn = base.xmat.reshape(3, 3)
    bodies = [model.body(i).name for i in range(1, model.nbody)]
    return {
        name: np.column_stack(
            [turn.T @ (data.body(name).xpos - base.xpos), turn.T @ data.body(name).xmat.reshape(3, 3)]
        )
        for name in bodies
    }


def test_bodies_between_the_two_are_turned_round_and_move_as_before(tmp_path: Path) -> None:
    """A robot whose IMU is on a torso above the file's first body was refused."""
    path = tmp_path / "own.xml"
    path.write_text(MODEL)
    before, after = read_spec(path).compile(), read_spec(path, "torso").compile()
    assert after.body("torso").parentid[0] == 0
    assert after.joint(0).name == "root"
    rng, hinges = np.random.default_rng(0), ("hip", "waist", "sway", "lean", "shoulder")
    for _ in range(5):
        angles = dict(zip(hinges, rng.uniform(-1.0, 1.0, len(hinges)), strict=True))
        was, now = (places(model, angles, "torso") for model in (before, after))
        assert set(was) == set(now)
        for name, place in was.items():
            assert now[name] == pytest.approx(place, abs=1e-5), name  # MuJoCo writes six digits
    for name in hinges:
        assert after.joint(name).damping == before.joint(name).damping
        at = int(after.joint(name).qposadr[0]), int(before.joint(name).qposadr[0])
        assert after.key_qpos[0, at[0]] == before.key_qpos[0, at[1]]
        dof = after.joint(name).dofadr[0], before.joint(name).dofadr[0]
        assert after.dof_armature[dof[0]] == before.dof_armature[dof[1]]
    assert after.body_mass.sum() == pytest.approx(before.body_mass.sum())


def test_a_model_without_a_free_joint_stays_as_it_is(tmp_path: Path) -> None:
    path = tmp_path / "own.xml"
    path.write_text(MODEL.replace('<freejoint name="root"/>', "").replace('qpos="0 0 1 1 0 0 0 ', 'qpos="'))
    assert read_spec(path, "torso").body("torso").parent.name == "spine"

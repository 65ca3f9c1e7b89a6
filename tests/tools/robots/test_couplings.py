"""Joints that a model ties to others: gears and belts, linkages, differentials."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import mujoco
import numpy as np
import pytest

from servoid.hw.config import CONFIGS, ConfigError
from servoid.hw.robot.description import Robot, load_robot, load_servo
from servoid.sim.joints.loops import Loops
from servoid.sim.model import build
from servoid.sim.rig.servo.plant import Plant
from servoid.sim.worlds import Worlds
from servoid.tools.cli import main
from servoid.tools.robots.compare import findings

WREN = (CONFIGS / "robots" / "wren.xml").read_text()
HORN = '<body pos="0.02 0 0"><joint name="{}_horn" axis="0 {} 0"/><geom size="0.004" mass="0.001" contype="0"/></body>'
EQUAL = '<joint joint1="{0}_knee" joint2="{0}_horn" polycoef="{1}"/>'


def geared(folder: Path, polycoef: str = "0 -0.5 0 0 0", equal: str = EQUAL, more: str = "") -> Path:
    """Wren with knees that turn by horns of their servos in the thighs, half as far and the other way round."""
    text = WREN
    for side, way in (("l", -1), ("r", -1)):
        knee = f'<body name="{side}_knee_link"'
        assert knee in text
        text = text.replace(knee, HORN.format(side, way) + knee)
    ties = "".join(equal.format(side, polycoef) for side in ("l", "r"))
    path = folder / "geared.xml"
    path.write_text(text.replace("</mujoco>", f"<equality>{ties}</equality>{more}</mujoco>"))
    return path


def imported(capsys: pytest.CaptureFixture[str], model: Path) -> tuple[Robot, list[str]]:
    out = model.with_suffix(".yaml")
    assert main(["robot", "import", str(model), "--out", str(out), "--no-picture", "--json"]) == 0
    return load_robot(out), json.loads(capsys.readouterr().out)["todo"]


MOTORS = '<actuator><motor joint="l_horn"/><motor joint="r_horn"/></actuator>'
TURNED = '<joint joint1="{0}_horn" joint2="{0}_knee" polycoef="0 -2 0 0 0"/>'


@pytest.mark.parametrize(("equal", "more"), [(EQUAL, ""), (TURNED, MOTORS)])
def test_a_leg_that_turns_by_a_gear_is_the_robots_and_its_horn_is_held(
    tmp_path: Path, capsys: pytest.CaptureFixture[str], equal: str, more: str
) -> None:
    """The horn was listed as the servo's joint, and the leg was refused."""
    robot, todo = imported(capsys, geared(tmp_path, equal=equal, more=more))
    assert robot.held == ("l_horn", "r_horn")
    assert robot.passive == ()
    assert "l_knee: l_horn turns it, 2 turns for one: the ID and direction are of that servo" in todo
    knee = robot.names.index("l_knee")
    assert robot.joints[knee].gear == pytest.approx(2.0)
    assert robot.servos[knee].stall_torque == pytest.approx(2.0 * load_servo("xm430-w350").stall_torque)
    assert robot.names == tuple(name for name in load_robot("wren").names if name in robot.names)
    assert {one.what for one in findings(robot) if not one.good} <= {"stiffness at home", "steps of the gait"}
    joints = tuple(replace(j, gear=1.5) if j.name == "l_knee" else j for j in robot.joints)
    (wrong,) = [one for one in findings(replace(robot, joints=joints)) if one.what == "gears"]
    assert (wrong.good, wrong.found) == (False, "l_knee 1.5, by the model 2")


def test_a_ratio_that_varies_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    model = geared(tmp_path, "0 -0.5 0.3 0 0")
    assert main(["robot", "import", str(model), "--out", str(tmp_path / "own.yaml"), "--no-picture"]) == 2
    assert "l_knee turns with l_horn in a ratio that varies" in capsys.readouterr().err
    assert not (tmp_path / "own.yaml").exists()


def test_a_leg_without_a_servo_is_refused_with_what_to_do(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """Which of two joints is the robot's is a person's mistake to make."""
    model = geared(tmp_path)
    imported(capsys, model)
    out = model.with_suffix(".yaml")
    text = out.read_text()
    swapped = text.replace("_horn", "_x").replace("held", "passive")
    out.write_text(swapped.replace("_knee", "_horn").replace("_x", "_knee"))
    with pytest.raises(
        ConfigError, match=r"'l_knee', on the way .* list it with its `gear`, and the servo's own joint"
    ):
        load_robot(out)
    out.write_text(text.replace("held: [l_horn, r_horn]", "held: [l_horn, r_horn, tail]"))
    with pytest.raises(ConfigError, match="no joint named 'tail'"):
        load_robot(out)


def test_joints_of_a_differential_are_held_and_named(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    joints = "".join(f'<joint joint="{name}" coef="{c}"/>' for name, c in (("l_horn", 1), ("r_horn", 1), ("nod", 1)))
    tendon = f'<tendon><fixed name="both" limited="true" range="-0.01 0.01">{joints}</fixed></tendon>'
    model = geared(tmp_path, equal="", more=tendon + MOTORS)
    nod = '<body pos="0 0 0.1"><joint name="nod" axis="0 1 0"/><geom size="0.01" mass="0.01"/></body>'
    model.write_text(model.read_text().replace('<site name="imu" pos="0 0 0.03"/>', f'<site name="imu"/>{nod}'))
    robot, todo = imported(capsys, model)
    assert set(robot.held) == {"nod", "l_horn", "r_horn"}
    assert any(text.startswith("l_horn, r_horn, nod: tendons tie several of them") for text in todo)
    assert build(robot).ntendon == 0


ROD = """<body name="crank" pos="0.03 0 0.08"><joint name="crank" axis="0 1 0"/>
<geom size="0.005" mass="0.005" contype="0" conaffinity="0"/>
<body name="rod" pos="0 0 0.02"><joint name="rod" axis="0 1 0"/>
<geom size="0.002" mass="0.002" contype="0" conaffinity="0"/><site name="end" pos="0 0 0.05"/></body></body>
<body name="lid" pos="0.03 0 0.13"><joint name="lid" axis="0 1 0"/>
<geom size="0.01" mass="0.01" contype="0" conaffinity="0"/><site name="pin" pos="0 0 0.02"/></body>"""


def test_a_closed_loop_is_closed_in_every_pose_that_a_body_begins_in(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """Passive joints began at 0 whatever the pose, and the loop tore at the robot when it was let go."""
    motors = "".join(f'<motor joint="{name}"/>' for name in (*load_robot("wren").names, "crank"))
    text = WREN.replace('<site name="imu" pos="0 0 0.03"/>', f'<site name="imu" pos="0 0 0.03"/>{ROD}')
    more = f'<equality><connect site1="end" site2="pin"/></equality><actuator>{motors}</actuator>'
    model = tmp_path / "lid.xml"
    model.write_text(text.replace("</mujoco>", more + "</mujoco>"))
    robot, _ = imported(capsys, model)
    assert set(robot.passive) == {"rod", "lid"}
    joints = tuple(replace(joint, home=0.6) if joint.name == "crank" else joint for joint in robot.joints)
    robot = replace(robot, joints=joints)

    def gap(model: mujoco.MjModel, qpos: np.ndarray) -> float:
        data = mujoco.MjData(model)
        data.qpos[:] = qpos
        mujoco.mj_kinematics(model, data)
        return float(np.linalg.norm(data.site("end").xpos - data.site("pin").xpos))

    worlds = Worlds(robot, 2, threads=1)
    worlds.reset(np.arange(2), [np.random.default_rng(i) for i in range(2)])
    assert max(gap(worlds.model, qpos) for qpos in worlds.truth.qpos) < 1e-5
    plant = Plant(robot)
    assert gap(plant.model, plant.data.qpos) < 1e-5
    begin = plant.data.qpos.copy()
    open_model = build(robot)
    loose = begin.copy()
    loose[[int(open_model.joint(name).qposadr[0]) for name in robot.passive]] = 0.0
    assert gap(open_model, loose) > 0.005
    for kept in (mujoco.mjtJacobian.mjJAC_DENSE, mujoco.mjtJacobian.mjJAC_SPARSE):
        open_model.opt.jacobian = kept
        closed = loose.copy()
        Loops(open_model, robot).close(closed)
        assert closed == pytest.approx(begin, abs=1e-4)

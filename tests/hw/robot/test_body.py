"""Legs, soles and heights are those of the MJCF, whatever its frames, and what cannot be a leg is named."""

from __future__ import annotations

from pathlib import Path
from shutil import copy

import mujoco
import numpy as np
import pytest
from hypothesis import Phase, given, settings
from hypothesis import strategies as st

from servoid.hw.config import CONFIGS, ConfigError, available
from servoid.hw.robot.description import Robot, load_robot
from servoid.hw.robot.legs import Legs
from servoid.sim.model import build

HEAD = """
rate: 50
name: own
mjcf: own.xml
base: torso
bus: {baud: 2000000}
limits: {joint_speed: 4.5, margin: 0.0, homing_speed: 0.5, tilt: 1.0, stale: 1, temperature: 70}
imu: {gyro_noise: 0, gyro_bias: 0, accelerometer_noise: 0, accelerometer_bias: 0, average: 0, latency: 0}
"""
BODY = """<mujoco><compiler angle="radian"/>
<worldbody><body name="ball" pos="1 0 0"><freejoint/><geom size="0.1"/></body>
<body name="torso" pos="0.3 0.2 1" euler="0.1 0.2 0.3"><freejoint/><geom size="0.05" mass="1"/>
<body pos="0 0.01 0.02" euler="0.3 0 0.5"><site name="imu" euler="0.5 0.2 0.1"/></body>{}</body></worldbody></mujoco>"""


def written(folder: Path, body: str, joints: list[str], feet: str, more: str = "", imu: str = "imu") -> Robot:
    rows = [
        f"  - {{name: {name}, servo: xm430-w350, id: {i}, direction: 1, zero: 0, range: [-3, 3], home: 0, "
        f"mirror: {name}, mirror_sign: 1}}\n"
        for i, name in enumerate(joints)
    ]
    (folder / "own.xml").write_text(BODY.format(body))
    (folder / "own.yaml").write_text(f"{HEAD}imu_site: {imu}\n{more}feet: {feet}\njoints:\n{''.join(rows)}")
    return load_robot(folder / "own.yaml")


def furthest(robot: Robot, poses: int = 20) -> float:
    """Greatest distance [m] of a sole's corner or centre by the legs from where MuJoCo has it, at random poses."""
    model, legs, rng = build(robot), Legs(robot), np.random.default_rng(0)
    data, worst = mujoco.MjData(model), 0.0
    for pose in rng.uniform(robot.lower, robot.upper, (poses, len(robot.joints))):
        data.qpos[:7] = 0, 0, 0, 1, 0, 0, 0
        for name, angle in zip(robot.names, pose, strict=True):
            data.joint(name).qpos = angle
        mujoco.mj_forward(model, data)
        soles, corners = legs.soles(legs.pick(pose))
        up = legs.forward(legs.pick(pose))[1][..., 2]
        for number, foot in enumerate(robot.legs):
            centre = data.sensor(f"servoid/{foot}_position").data
            worst = max(worst, float(np.abs(soles[number] - centre).max()))
            worst = max(worst, float(np.abs(up[number] - data.sensor(f"servoid/{foot}_up").data).max()))
            worst = max(worst, float(np.abs(corners[number].mean(0) - centre).max()))
    return worst


@pytest.mark.parametrize("name", available("robots"))
def test_legs_of_shipped_robots_are_those_of_mujoco(name: str) -> None:
    assert furthest(load_robot(name)) < 1e-9


number = st.floats(-1.0, 1.0).map(lambda x: round(x, 3))
vector = st.tuples(number, number, number)
part = st.tuples(vector, vector, vector.filter(lambda v: np.linalg.norm(v) > 0.1), vector, st.integers(0, 2))


@settings(max_examples=25, deadline=None, phases=(Phase.explicit, Phase.generate))
@given(waist=st.lists(part, max_size=2), legs=st.lists(st.tuples(part, part), min_size=1, max_size=5))
def test_legs_of_any_build_are_those_of_mujoco(
    tmp_path_factory: pytest.TempPathFactory, waist: list[tuple], legs: list[tuple]
) -> None:
    """Frames turned any way, axes askew and away from the body's origin, fixed bodies and several joints between, and a
    waist that both legs share: each of them once put ankles centimetres away, and nothing said so."""
    joints: list[str] = []

    def opened(side: str, parts: list[tuple]) -> tuple[str, int]:
        text, depth = "", 0
        for place, euler, axis, anchor, fixed in parts:
            name = f"{side}{len(joints)}"
            joints.append(name)
            text += (
                f'<body pos="{" ".join(map(str, np.multiply(place, 0.1)))}" euler="{" ".join(map(str, euler))}">'
                * (fixed + 1)
            )
            text += f'<joint name="{name}" axis="{" ".join(map(str, axis))}" pos="{" ".join(map(str, anchor))}"/>'
            text += '<geom size="0.01" mass="0.1" contype="0" conaffinity="0"/>'
            depth += fixed + 1
        return text, depth

    start, depth = opened("waist", waist)
    text = start
    for i, side in enumerate(("left", "right")):
        leg, deep = opened(side, [pair[i] for pair in legs])
        text += f'{leg}<geom name="{side}" type="box" size="0.05 0.03 0.01"/>{"</body>" * deep}'
    folder = tmp_path_factory.mktemp("chain")
    robot = written(
        folder, text + "</body>" * depth, joints, "{left: {geoms: [left]}, right: {geoms: [right]}}", HEIGHT
    )
    assert furthest(robot, 3) < 1e-6


HEIGHT = "standing_height: 0.005\n"  # the chains stand nowhere
LEG = '<body name="shank"><joint name="knee" axis="0 1 0"/><geom name="foot" size="0.02" mass="1"/>{}</body>'


@pytest.mark.parametrize(
    ("body", "feet", "said"),
    [
        (LEG.replace('axis="0 1 0"', 'type="ball"'), "[foot]", "joint 'knee' is not a hinge"),
        ("<geom name='foot' size='0.02'/>" + LEG.replace("foot", "sole"), "[foot]", "no joint leads from the base"),
        (LEG, "[torso.0, foot]", "on bodies that move against each other"),
        (LEG + '<body><joint name="waist"/><geom size="0.1" mass="1"/></body>', "[foot]", "does not list: waist"),
    ],
)
def test_what_cannot_be_a_leg_is_named(tmp_path: Path, body: str, feet: str, said: str) -> None:
    with pytest.raises(ConfigError, match=said):
        written(tmp_path, body.replace("{}", ""), ["knee"], f"{{one: {{geoms: {feet}}}}}", HEIGHT)


def test_a_foot_that_is_not_the_robots_is_named(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"geom 'ball\.0', of a sole, is no descendant of the base 'torso'"):
        written(tmp_path, LEG.replace("{}", ""), ["knee"], "{one: {geoms: [ball.0]}}", HEIGHT)


def test_an_imu_that_moves_against_the_base_is_refused(tmp_path: Path) -> None:
    body = LEG.replace("{}", '<site name="head"/>')
    with pytest.raises(ConfigError, match="imu_site: 'head' is on body 'shank', which moves against"):
        written(tmp_path, body, ["knee"], "{one: {geoms: [foot]}}", HEIGHT, imu="head")


OP3_LEG = """legs:
  left:
    - {joint: l_hip_yaw, offset: [0, 0.035, 0], axis: [0, 0, -1]}
    - {joint: l_hip_roll, offset: [-0.024, 0, -0.0285], axis: [-1, 0, 0]}
    - {joint: l_hip_pitch, offset: [0.0241, 0.019, 0], axis: [0, 1, 0]}
    - {joint: l_knee, offset: [0, 0, -0.11015], axis: [0, 1, 0]}
    - {joint: l_ank_pitch, offset: [0, 0, -0.11], axis: [0, -1, 0]}
    - {joint: l_ank_roll, offset: [-0.0241, -0.019, 0], axis: [1, 0, 0]}
"""


@pytest.mark.parametrize(
    ("old", "new", "said"),
    [
        ("", "", ""),
        ("-0.11015]", "-0.1202]", r"legs.left\[3\]: l_knee: its offset is 10.1 mm, its axis 0.000 beside"),
        (
            "axis: [0, 1, 0]}\n    - {joint: l_ank",
            "axis: [0.5, 0.866, 0]}\n    - {joint: l_ank",
            "its axis 0.500 beside",
        ),
        ("l_knee,", "r_knee,", "the joints that lead to this foot in .* are l_hip_yaw, l_hip_roll"),
        ("left:", "middle:", "legs.middle: no foot of that name"),
    ],
)
def test_legs_of_an_older_file_must_be_those_of_the_mjcf(tmp_path: Path, old: str, new: str, said: str) -> None:
    assert old in OP3_LEG
    copy(CONFIGS / "robots" / "op3.xml", tmp_path)
    text = (CONFIGS / "robots" / "op3.yaml").read_text()
    (tmp_path / "op3.yaml").write_text(text + OP3_LEG.replace(old, new, 1))
    if not said:
        assert load_robot(tmp_path / "op3.yaml").legs == load_robot().legs
        return
    with pytest.raises(ConfigError, match=said):
        load_robot(tmp_path / "op3.yaml")


def test_a_sole_in_another_frame_is_refused_and_one_left_out_is_found(tmp_path: Path) -> None:
    """`sole` meant the last link's frame here and its body's there."""
    copy(CONFIGS / "robots" / "op3.xml", tmp_path)
    text = (CONFIGS / "robots" / "op3.yaml").read_text()
    given = "sole: [0.024, 0.013, -0.0305], half_size: [0.0635, 0.039]"
    assert text.count(given) == 1
    (tmp_path / "op3.yaml").write_text(text.replace(given, "sole: [0.0305, 0.013, 0.024]"))
    with pytest.raises(ConfigError, match=r"feet.left.sole: is 55 mm from the sole of l_sole_long, l_sole_wide"):
        load_robot(tmp_path / "op3.yaml")
    (tmp_path / "op3.yaml").write_text(text.replace(", " + given, "").replace("standing_height: 0.259", ""))
    robot = load_robot(tmp_path / "op3.yaml")
    assert robot.feet["left"].sole == pytest.approx((0.024, 0.0125, -0.0305))
    assert robot.feet["left"].half_size == pytest.approx((0.0635, 0.039))
    assert robot.standing_height == pytest.approx(0.259, abs=2e-3)


def test_a_urdf_is_the_same_robot_as_its_mjcf(tmp_path: Path) -> None:
    """With fixed links kept, and a mesh that only shows it and that MuJoCo cannot read left out."""
    inertial = '<inertial><mass value="1"/><inertia ixx="1" iyy="1" izz="1" ixy="0" ixz="0" iyz="0"/></inertial>'
    # Files made by xacro call every shape `collision`, and MuJoCo warned of each, in a screen full of lines.
    shape = '<collision name="collision"><origin xyz="{}"/><geometry><box size="{}"/></geometry></collision>'
    box = shape.format("0.02 0 -0.1", "0.1 0.06 0.02")
    shell = '<visual><geometry><mesh filename="package://own/shell.dae"/></geometry></visual>'
    shell += shape.format("0 0 0", "0.01 0.01 0.01")
    torso, shank = f'<link name="torso">{inertial}{shell}</link>', f'<link name="shank">{inertial}{box}</link>'
    links = f'{torso}<link name="imu_link"/>{shank}'
    joints = """<joint name="f" type="fixed"><parent link="torso"/><child link="imu_link"/></joint>
    <joint name="knee" type="revolute"><parent link="torso"/><child link="shank"/>
    <origin xyz="0 0.1 -0.2" rpy="0 0 1.2"/><axis xyz="0 1 0"/>
    <limit lower="-1" upper="1" effort="3" velocity="2"/></joint>"""
    (tmp_path / "own.urdf").write_text(f'<robot name="own">{links}{joints}</robot>')
    source = '<body pos="0 0.1 -0.2" euler="0 0 1.2"><joint name="knee" axis="0 1 0"/>{}</body>'
    foot = '<geom name="shank.0" type="box" pos="0.02 0 -0.1" size="0.05 0.03 0.01"/>'
    mjcf = written(tmp_path, source.replace("{}", foot), ["knee"], "{one: {geoms: [shank.0]}}", "")
    text = (tmp_path / "own.yaml").read_text().replace("own.xml", "own.urdf")
    (tmp_path / "own.yaml").write_text(text.replace("imu_site: imu", "imu_site: imu_link"))
    robot = load_robot(tmp_path / "own.yaml")
    np.testing.assert_allclose(
        Legs(robot).soles(np.array([[0.4]]))[1], Legs(mjcf).soles(np.array([[0.4]]))[1], atol=1e-9
    )
    assert furthest(robot) < 1e-9
    (tmp_path / "own.urdf").write_text(f'<robot name="own">{links}{joints}')
    with pytest.raises(ConfigError, match=r"own.urdf: not a valid MJCF or URDF"):
        load_robot(tmp_path / "own.yaml")

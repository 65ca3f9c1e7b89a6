"""The simulated robot is the one in the manufacturer's table, and the servo the one in its file."""

from pathlib import Path

import mujoco
import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.hw.robot.legs import LegInverse, Legs
from servoid.sim.model import TIMESTEP, _add_servo, build

# body: parent, offset, joint axis, mass, centre of mass, sorted principal moments (left side and middle)
TABLE = {
    "head_pan_link": (
        "body_link", (-0.001, 0, 0.1365), (0, 0, 1),
        0.01176, (0.00233, 0, 0.00823), (4.234e-06, 3.606e-06, 1.65e-06),
    ),
    "head_tilt_link": (
        "head_pan_link", (0.01, 0.019, 0.0285), (0, -1, 0),
        0.13631, (0.0023, -0.01863, 0.0277), (0.000107452, 8.72266e-05, 4.39413e-05),
    ),
    "l_sho_pitch_link": (
        "body_link", (-0.001, 0.06, 0.111), (0, 1, 0),
        0.01176, (0, 0.00823, -0.00233), (4.234e-06, 3.606e-06, 1.65e-06),
    ),
    "l_sho_roll_link": (
        "l_sho_pitch_link", (0.019, 0.0285, -0.01), (-1, 0, 0),
        0.17758, (-0.01844, 0.04514, 0.00028), (0.000234742, 0.00022804, 3.04183e-05),
    ),
    "l_el_link": (
        "l_sho_roll_link", (0, 0.0904, -0.0001), (1, 0, 0),
        0.04127, (-0.019, 0.07033, 0.0038), (6.8785e-05, 6.196e-05, 1.2065e-05),
    ),
    "l_hip_yaw_link": (
        "body_link", (0, 0.035, 0), (0, 0, -1),
        0.01181, (-0.00157, 0, -0.00774), (4.3e-06, 4.12e-06, 1.51e-06),
    ),
    "l_hip_roll_link": (
        "l_hip_yaw_link", (-0.024, 0, -0.0285), (-1, 0, 0),
        0.17886, (0.00388, 0.00028, -0.01214), (0.000125243, 0.000108598, 4.65693e-05),
    ),
    "l_hip_pitch_link": (
        "l_hip_roll_link", (0.0241, 0.019, 0), (0, 1, 0),
        0.11543, (0.00059, -0.01901, -0.08408), (0.000104996, 9.63044e-05, 2.47492e-05),
    ),
    "l_knee_link": (
        "l_hip_pitch_link", (0, 0, -0.11015), (0, 1, 0),
        0.04015, (0, -0.02151, -0.055), (3.715e-05, 2.751e-05, 1.511e-05),
    ),
    "l_ank_pitch_link": (
        "l_knee_link", (0, 0, -0.11), (0, -1, 0),
        0.17886, (-0.02022, -0.01872, 0.01214), (0.000125243, 0.000108598, 4.65693e-05),
    ),
    "l_ank_roll_link": (
        "l_ank_pitch_link", (-0.0241, -0.019, 0), (1, 0, 0),
        0.06934, (0.02373, 0.01037, -0.0276), (0.000115818, 7.87135e-05, 4.03389e-05),
    ),
}  # fmt: skip
RIGHT_AXES = {
    "r_sho_pitch": (0, -1, 0), "r_sho_roll": (-1, 0, 0), "r_el": (1, 0, 0), "r_hip_yaw": (0, 0, -1),
    "r_hip_roll": (-1, 0, 0), "r_hip_pitch": (0, -1, 0), "r_knee": (0, -1, 0), "r_ank_pitch": (0, 1, 0),
    "r_ank_roll": (1, 0, 0),
}  # fmt: skip
MIRROR = np.array([1, -1, 1])
# Principal axes in the body's frame, quaternion w x y z; the moments, largest first, are the table's.
AXES = {
    "body_link": (0.704708, 0.704003, 0.0667707, -0.0575246),
    "head_pan_link": (0.663575, 0.663575, 0.244272, -0.244272),
    "head_tilt_link": (0.997312, 0.00973825, 0.0726131, -0.00102702),
    "l_sho_pitch_link": (0.244272, 0.663575, 0.244272, 0.663575),
    "r_sho_pitch_link": (-0.244272, 0.663575, -0.244272, 0.663575),
    "l_sho_roll_link": (0.501853, 0.50038, -0.498173, 0.499588),
    "r_sho_roll_link": (0.50038, 0.501853, -0.499588, 0.498173),
    "l_el_link": (0.483289, 0.51617, -0.51617, 0.483289),
    "r_el_link": (0.51617, 0.483289, -0.483289, 0.51617),
    "l_hip_yaw_link": (0.499041, 0.500957, 0.500957, 0.499041),
    "r_hip_yaw_link": (0.499041, 0.500957, 0.500957, 0.499041),
    "l_hip_roll_link": (0.502657, 0.490852, 0.498494, 0.507842),
    "r_hip_roll_link": (0.507842, 0.498494, 0.490852, 0.502657),
    "l_hip_pitch_link": (0.999682, 0.0246915, 0.00447825, -0.002482),
    "r_hip_pitch_link": (0.999682, -0.0246915, 0.00447825, 0.002482),
    "l_knee_link": (1, 0, 0, 0),
    "r_knee_link": (1, 0, 0, 0),
    "l_ank_pitch_link": (0.490852, 0.502657, 0.507842, 0.498494),
    "r_ank_pitch_link": (0.498494, 0.507842, 0.502657, 0.490852),
    "l_ank_roll_link": (0.0078515, 0.707601, 0.0113965, 0.706477),
    "r_ank_roll_link": (-0.0078515, 0.707601, -0.0113965, 0.706477),
}


@pytest.fixture(scope="module")
def model() -> mujoco.MjModel:
    return build(load_robot())


def _rows() -> list[tuple]:
    rows = []
    for body, (parent, offset, axis, mass, centre, inertia) in TABLE.items():
        rows.append((body, parent, offset, axis, mass, centre, inertia))
        if body.startswith("l_"):
            other, above = "r" + body[1:], parent if parent == "body_link" else "r" + parent[1:]
            axis = RIGHT_AXES[other.removesuffix("_link")]
            rows.append((other, above, MIRROR * offset, axis, mass, MIRROR * centre, inertia))
    return rows


@pytest.mark.parametrize("row", _rows(), ids=lambda row: row[0])
def test_body_equals_the_table(model: mujoco.MjModel, row: tuple) -> None:
    name, parent, offset, axis, mass, centre, inertia = row
    body = model.body(name)
    assert model.body(body.parentid[0]).name == parent
    np.testing.assert_allclose(body.pos, offset, atol=1e-9)
    np.testing.assert_allclose(model.joint(name.removesuffix("_link")).axis, axis, atol=1e-9)
    assert body.mass[0] == pytest.approx(mass)
    np.testing.assert_allclose(body.ipos, centre, atol=1e-9)
    np.testing.assert_allclose(np.sort(body.inertia), np.sort(inertia), rtol=1e-6)


def test_moments_are_about_the_bodies_own_axes(model: mujoco.MjModel) -> None:
    """Taken along the links' axes, hip yaw was 17 % too light."""
    moments = {row[0]: row[-1] for row in _rows()} | {"body_link": (0.00341264, 0.00316574, 0.00296931)}
    for name, axes in AXES.items():
        turn, own = np.zeros(9), np.zeros(9)
        mujoco.mju_quat2Mat(turn, np.array(axes) / np.linalg.norm(axes))
        mujoco.mju_quat2Mat(own, model.body(name).iquat)
        wanted = turn.reshape(3, 3) @ np.diag(moments[name]) @ turn.reshape(3, 3).T
        given = own.reshape(3, 3) @ np.diag(model.body(name).inertia) @ own.reshape(3, 3).T
        np.testing.assert_allclose(given, wanted, atol=1e-5 * np.trace(wanted), err_msg=name)
    assert AXES.keys() == {model.body(i).name for i in range(1, model.nbody)}


def test_whole_robot(model: mujoco.MjModel) -> None:
    assert model.body_mass.sum() == pytest.approx(3.147, abs=1e-3)
    body = model.body("body_link")
    np.testing.assert_allclose(body.ipos, (-0.01501, 0.00013, 0.06582))
    np.testing.assert_allclose(body.inertia, (0.00341264, 0.00316574, 0.00296931))
    assert [model.actuator(i).name for i in range(model.nu)] == list(load_robot().names)


def test_every_body_collides(model: mujoco.MjModel) -> None:
    colliding = {int(b) for b, c in zip(model.geom_bodyid, model.geom_conaffinity, strict=True) if c}
    assert colliding == set(range(model.nbody))


@pytest.mark.parametrize(
    ("pose", "met"),
    [
        ({}, set()),
        ({"l_hip_pitch": -1.97}, {("l_thigh", "pelvis")}),
        ({"r_hip_pitch": 1.97}, {("r_thigh", "pelvis")}),
    ],
    ids=["home", "left", "right"],
)
def test_thighs_meet_the_trunk_where_the_ranges_end(
    model: mujoco.MjModel, pose: dict[str, float], met: set[tuple[str, str]]
) -> None:
    data, robot = mujoco.MjData(model), load_robot()
    data.qpos[2] = 1.0  # clear of the floor
    for name, value in zip(robot.names, robot.home, strict=True):
        data.joint(name).qpos = pose.get(name, value)
    mujoco.mj_forward(model, data)
    meeting = {tuple(sorted(model.geom(int(g)).name for g in contact.geom)) for contact in data.contact}
    assert meeting == {tuple(sorted(pair)) for pair in met}


def test_leg_kinematics_equal_mujoco(model: mujoco.MjModel) -> None:
    robot = load_robot()
    legs, data = Legs(robot), mujoco.MjData(model)
    for q in np.random.default_rng(0).uniform(-0.6, 0.6, (5, 20)):
        mujoco.mj_resetData(model, data)
        data.qpos[:7] = [0, 0, 0, 1, 0, 0, 0]
        for name, value in zip(robot.names, q, strict=True):
            data.joint(name).qpos = value
        mujoco.mj_forward(model, data)
        position, rotation, _, _ = legs.forward(legs.pick(q))
        for leg, body in enumerate(("l_ank_roll_link", "r_ank_roll_link")):
            np.testing.assert_allclose(position[leg], data.body(body).xpos, atol=1e-9)
            np.testing.assert_allclose(rotation[leg].ravel(), data.body(body).xmat, atol=1e-9)


def test_leg_inverse_is_the_inverse() -> None:
    robot = load_robot()
    legs = Legs(robot)
    inverse = LegInverse(legs, robot.name)
    rng = np.random.default_rng(1)
    ankle = inverse.hip + rng.uniform(-0.03, 0.03, (50, 2, 3)) + [0, 0, -0.17]
    yaw = rng.uniform(-0.5, 0.5, (50, 2))
    c, s, zero, one = np.cos(yaw), np.sin(yaw), np.zeros_like(yaw), np.ones_like(yaw)
    turn = np.stack([np.stack(row, -1) for row in ((c, -s, zero), (s, c, zero), (zero, zero, one))], -2)
    position, rotation, _, _ = legs.forward(inverse(ankle, turn))
    reached = position + np.einsum("...ij,...j->...i", rotation, inverse.ankle)
    np.testing.assert_allclose(reached, ankle, atol=2e-4)  # the robot's own axes miss each other by 0.1 mm
    np.testing.assert_allclose(rotation, turn, atol=1e-9)


def test_servo_follows_its_torque_speed_curve() -> None:
    """A DC motor under the firmware's law, with the braking limit, from the servo's file."""
    servo = load_robot().servos[0]
    spec = mujoco.MjSpec.from_string(
        '<mujoco><worldbody><body><joint name="j"/><geom size="0.1" mass="1"/></body></worldbody></mujoco>'
    )
    _add_servo(spec, "j", servo)
    model = spec.compile()
    data = mujoco.MjData(model)
    k = servo.voltage / servo.no_load_speed
    r = k * servo.voltage / servo.stall_torque
    for error in (-1.0, -0.1, 0.0, 0.05, 0.2, 1.0):
        for speed in (-4.5, -2.0, 0.0, 0.5, 3.0, 4.55):
            data.qpos[0], data.qvel[0], data.ctrl[0] = 0.0, speed, error
            mujoco.mj_forward(model, data)
            volts = np.clip(servo.stiffness * error * r / k, -servo.voltage, servo.voltage)
            torque = np.clip(k / r * (volts - k * speed), -servo.braking_torque, servo.braking_torque)
            assert data.actuator_force[0] == pytest.approx(torque, abs=1e-9)
    data.qvel[0], data.ctrl[0] = 0.0, 10.0
    mujoco.mj_forward(model, data)
    assert data.actuator_force[0] == pytest.approx(2.95)  # stall
    data.qvel[0] = servo.no_load_speed
    mujoco.mj_forward(model, data)
    assert data.actuator_force[0] == pytest.approx(0.0, abs=1e-9)  # no torque left at the no-load speed


def test_own_mjcf_lacking_something_is_refused(tmp_path: Path) -> None:
    text = Path(load_robot().mjcf).read_text()
    source = Path("configs/robots/op3.yaml").read_text()
    for old, new, named in (
        ('joint name="l_knee"', 'joint name="left_knee"', "l_knee"),
        ('site name="imu"', 'site name="imu2"', "imu"),
        ('geom name="l_sole_long"', 'geom name="l_sole"', "l_sole_long"),
    ):
        (tmp_path / "own.xml").write_text(text.replace(old, new))
        (tmp_path / "own.yaml").write_text(source.replace("mjcf: op3.xml", "mjcf: own.xml"))
        with pytest.raises(ConfigError, match=named) as error:
            build(load_robot(tmp_path / "own.yaml"))
        assert "own.xml" in str(error.value)


def test_own_actuators_are_replaced(tmp_path: Path) -> None:
    text = Path(load_robot().mjcf).read_text()
    motor = '<actuator><motor joint="l_knee"/></actuator></mujoco>'
    (tmp_path / "own.xml").write_text(text.replace("</mujoco>", motor))
    source = Path("configs/robots/op3.yaml").read_text().replace("mjcf: op3.xml", "mjcf: own.xml")
    (tmp_path / "own.yaml").write_text(source)
    assert build(load_robot(tmp_path / "own.yaml")).nu == 20


def test_timestep_divides_the_tick() -> None:
    assert (load_robot().dt / TIMESTEP) == pytest.approx(round(load_robot().dt / TIMESTEP))

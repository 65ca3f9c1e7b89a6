"""The shipped robot against the manufacturer's table, and robot files that cannot be true."""

from __future__ import annotations

import re
from dataclasses import replace
from pathlib import Path
from shutil import copy

import numpy as np
import pytest

from servoid.hw.config import CONFIGS, ConfigError
from servoid.hw.robot.description import Walking, load_robot, load_servo, save_robot

PI = np.pi

# name, servo ID, range by the kinematics source; the order is that of every array
TABLE = [
    ("head_pan", 19, -0.5 * PI, 0.5 * PI),
    ("head_tilt", 20, -0.5 * PI, 0.5 * PI),
    ("l_sho_pitch", 2, -0.5 * PI, 0.5 * PI),
    ("l_sho_roll", 4, -0.3 * PI, 0.5 * PI),
    ("l_el", 6, -0.5 * PI, 0.5 * PI),
    ("r_sho_pitch", 1, -0.5 * PI, 0.5 * PI),
    ("r_sho_roll", 3, -0.5 * PI, 0.3 * PI),
    ("r_el", 5, -0.5 * PI, 0.5 * PI),
    ("l_hip_yaw", 8, -0.45 * PI, 0.45 * PI),
    ("l_hip_roll", 10, -0.3 * PI, 0.3 * PI),
    ("l_hip_pitch", 12, -0.4 * PI, 0.4 * PI),
    ("l_knee", 14, -0.1 * PI, 0.7 * PI),
    ("l_ank_pitch", 16, -0.45 * PI, 0.45 * PI),
    ("l_ank_roll", 18, -0.45 * PI, 0.45 * PI),
    ("r_hip_yaw", 7, -0.45 * PI, 0.45 * PI),
    ("r_hip_roll", 9, -0.3 * PI, 0.3 * PI),
    ("r_hip_pitch", 11, -0.4 * PI, 0.4 * PI),
    ("r_knee", 13, -0.7 * PI, 0.1 * PI),
    ("r_ank_pitch", 15, -0.45 * PI, 0.45 * PI),
    ("r_ank_roll", 17, -0.45 * PI, 0.45 * PI),
]

# Where the manufacturer's own motions go further (its action file), and so may this robot: low, high.
FURTHER = {
    "head_tilt": (-2.05, None),
    "l_sho_pitch": (-2.85, 2.42),
    "l_sho_roll": (-1.85, None),
    "l_el": (-2.6, None),
    "l_hip_pitch": (-1.97, None),
    "l_knee": (None, 2.51),
    "l_ank_pitch": (None, 1.84),
}

# joint, offset in its parent [m], axis
LEFT_LEG = [
    ("l_hip_yaw", (0, 0.035, 0), (0, 0, -1)),
    ("l_hip_roll", (-0.024, 0, -0.0285), (-1, 0, 0)),
    ("l_hip_pitch", (0.0241, 0.019, 0), (0, 1, 0)),
    ("l_knee", (0, 0, -0.11015), (0, 1, 0)),
    ("l_ank_pitch", (0, 0, -0.11), (0, -1, 0)),
    ("l_ank_roll", (-0.0241, -0.019, 0), (1, 0, 0)),
]
RIGHT_AXES = [(0, 0, -1), (-1, 0, 0), (0, -1, 0), (0, -1, 0), (0, 1, 0), (1, 0, 0)]


def test_joints_equal_the_table() -> None:
    robot = load_robot("op3")
    assert [(joint.name, joint.id) for joint in robot.joints] == [row[:2] for row in TABLE]
    low, high = [row[2] for row in TABLE], [row[3] for row in TABLE]
    for name, (lower, upper) in FURTHER.items():
        i = robot.names.index(name)
        low[i], high[i] = low[i] if lower is None else lower, high[i] if upper is None else upper
        if name.startswith("l_"):
            other = robot.names.index("r" + name[1:])
            low[other], high[other] = -high[i], -low[i]
    np.testing.assert_allclose(robot.lower, low, atol=1e-4)
    np.testing.assert_allclose(robot.upper, high, atol=1e-4)
    assert {servo.name for servo in robot.servos} == {"xm430-w350"}
    assert robot.bus.board_id == 200


def test_legs_equal_the_table() -> None:
    robot = load_robot("op3")
    assert [(link.joint, link.offset, link.axis) for link in robot.legs["left"]] == LEFT_LEG
    for right, (name, offset, _), axis in zip(robot.legs["right"], LEFT_LEG, RIGHT_AXES, strict=True):
        assert right.joint == "r" + name[1:]
        assert right.offset == (offset[0], -offset[1], offset[2])
        assert right.axis == axis
    assert robot.leg_index.tolist() == [list(range(8, 14)), list(range(14, 20))]


def test_mirror_is_an_involution_that_keeps_home_and_ranges() -> None:
    robot = load_robot("op3")
    index, sign = robot.mirror
    pose = np.random.default_rng(0).normal(size=20)
    np.testing.assert_array_equal((pose[index] * sign)[index] * sign, pose)
    np.testing.assert_allclose(robot.home[index] * sign, robot.home)
    ends = np.sort(np.stack([robot.lower[index] * sign, robot.upper[index] * sign]), axis=0)
    np.testing.assert_allclose(ends[0, 2:], robot.lower[2:])  # the head's two joints are their own mirrors
    np.testing.assert_allclose(ends[1, 2:], robot.upper[2:])


def test_servo_is_the_datasheets() -> None:
    servo = load_servo("xm430-w350")
    assert (servo.model_number, servo.ticks_per_turn, servo.center_tick) == (1020, 4096, 2048)
    assert servo.velocity_unit == pytest.approx(0.229 * 2 * PI / 60)
    assert servo.current_unit == pytest.approx(2.69e-3)


def edited(tmp_path: Path, kind: str, name: str, old: str, new: str) -> tuple[Path, int]:
    """A copy of a shipped file with the first `old` replaced, and the line of the change."""
    text = (CONFIGS / kind / name).read_text()
    assert old in text
    path = tmp_path / name
    path.write_text(text.replace(old, new, 1))
    copy(CONFIGS / "robots" / "op3.xml", tmp_path)
    return path, text[: text.index(old)].count("\n") + 1


ROLL = "{name: l_sho_roll, servo: xm430-w350, id: 4, direction: 1, zero: 0.0, range: [-1.85, 1.5708], home: 1.2"


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        (ROLL, ROLL.replace("[-1.85, 1.5708]", "[1.5708, -1.85]"), "joints[3].range: l_sho_roll: upside down"),
        (ROLL, ROLL.replace("1.5708]", "90]"), "l_sho_roll: 90 is more than a turn: angles are in radians"),
        (ROLL, ROLL.replace("home: 1.2", "home: 45"), "joints[3].home: l_sho_roll: 45 is more than a turn"),
        (ROLL, ROLL.replace("home: 1.2", "home: 1.6"), "joints[3].home: l_sho_roll: 1.6 is outside the range"),
        (ROLL, ROLL.replace("id: 4", "id: 2"), "duplicate servo ID 2: l_sho_roll and l_sho_pitch have it"),
        (ROLL, ROLL.replace("id: 4", "id: 200"), "duplicate servo ID 200: l_sho_roll and the board"),
        (ROLL, ROLL.replace("id: 4", "id: 253"), "servo IDs are 0..252, not 253"),
        (ROLL, ROLL.replace("home: 1.2", "gear: 0, home: 1.2"), "joints[3].gear: must be positive, not 0"),
        (ROLL, ROLL.replace("direction: 1", "direction: 0"), "direction: l_sho_roll: must be 1 or -1, not 0"),
        (ROLL, ROLL.replace("xm430-w350", "xm430-w250"), "unknown servo 'xm430-w250'; did you mean 'xm430-w350'"),
        (ROLL, ROLL.replace("zero: 0.0", "zreo: 0.0"), "joints[3].zreo: unknown key; did you mean 'zero'"),
        ("name: r_el, ", "name: l_el, ", "duplicate joint name 'l_el'"),
        ("mirror: r_knee", "mirror: r_kne", "l_knee: unknown joint 'r_kne'; did you mean 'r_knee'"),
        ("mirror: r_knee", "mirror: r_ank_roll", "l_knee names r_ank_roll as its mirror, but r_ank_roll names"),
        ("mirror: r_knee, mirror_sign: -1", "mirror: r_knee, mirror_sign: 2", "must be 1 or -1, not 2"),
        ("mirror: r_knee, mirror_sign: -1", "mirror: r_knee, mirror_sign: 1", "must have the same sign"),
        ("rate: 50 ", "rate: 0 ", "rate: must be positive, not 0"),
        ("joint_speed: 4.5", "joint_speed: -4.5", "limits.joint_speed: must be positive"),
        ("forward: 0.5", "forward: -0.5", "walking.forward: must be positive, not -0.5"),
        ("tilt: 1.047", "tilt: 60", "limits.tilt: 60 is more than a turn"),
        ("joint_speed: 4.5 ", "joint_speed: 4.5rad/s ", "without the unit 'rad/s'"),
        ("derate_temperature: 60", "derate_temperature: 75", "75 is not between 0 and limits.temperature (70)"),
        ("derate_voltage: 10.5", "derate_voltage: 9.9", "limits.derate_voltage: 9.9 V is not above limits.voltage"),
        ("stop_buttons: [mode,", "stop_buttons: [mod,", "bus.stop_buttons[0]: expected one of mode, start, user"),
        ("average: 0.020", "average: -0.020", "imu.average: must not be negative, not -0.02"),
        ("kind: opencr", "kind: openrc", "imu.kind: expected one of opencr, witmotion, bno08x"),
        ("kind: opencr", "kind: bno08x", "imu.kind: a bno08x has a serial port of its own: name it as imu.port"),
        ("signs: [-1, -1, 1]", "signs: [-1, -1, 0]", "imu.signs[2]: must be 1 or -1, not 0"),
        ("mounting: [0, 0, 0]", "mounting: [0, 0, 90]", "imu.mounting[2]: 90 is more than a turn: angles are in rad"),
    ],
)
def test_a_robot_that_cannot_be_is_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    path, line = edited(tmp_path, "robots", "op3.yaml", old, new)
    with pytest.raises(ConfigError, match=re.escape(words)) as caught:
        load_robot(path)
    assert str(caught.value).startswith(f"{path}:{line}: "), caught.value


@pytest.mark.parametrize(
    ("new", "words"),
    [
        (
            "kind: witmotion\n  port: /dev/ttyUSB1\n  signs: [-1, -1, -1]",
            "imu.signs: a witmotion has right-handed axes",
        ),
        ("port: /dev/ttyUSB1\n  signs: [-1, -1, 1]", "imu.port: the board's IMU is on the servo bus: drop the port"),
        ("baud: 0\n  signs: [-1, -1, 1]", "imu.baud: must be positive"),
    ],
)
def test_an_imu_that_cannot_be_is_refused(tmp_path: Path, new: str, words: str) -> None:
    old = "signs: [-1, -1, 1]"
    if new.startswith("kind"):
        edited(tmp_path, "robots", "op3.yaml", "  kind: opencr              # the board's", "  # the board's")
        text = (tmp_path / "op3.yaml").read_text().replace(old, new, 1)
    else:
        text = (CONFIGS / "robots" / "op3.yaml").read_text().replace(old, new, 1)
    (tmp_path / "op3.yaml").write_text(text)
    with pytest.raises(ConfigError, match=re.escape(words)):
        load_robot(tmp_path / "op3.yaml")


def test_a_robot_file_that_says_nothing_of_it_has_the_boards_imu_and_any_button_stops(tmp_path: Path) -> None:
    lines = (CONFIGS / "robots" / "op3.yaml").read_text().splitlines()
    new = ("kind: opencr", "signs: [", "mounting: [", "stop_buttons", "derate_", "voltage: 10")
    kept = [line for line in lines if not line.strip().startswith(new)]
    assert len(kept) == len(lines) - 7
    (tmp_path / "old.yaml").write_text("\n".join(kept))
    copy(CONFIGS / "robots" / "op3.xml", tmp_path)
    robot = load_robot(tmp_path / "old.yaml")
    assert (robot.imu.kind, robot.imu.port, robot.imu.signs) == ("opencr", None, (1.0, 1.0, 1.0))
    assert robot.bus.stop_buttons == ("mode", "start", "user")
    assert (robot.limits.derate_temperature, robot.limits.voltage, robot.limits.derate_voltage) == (None, None, None)


@pytest.mark.parametrize(
    ("old", "new", "words"),
    [
        ("stall_torque: 2.95", "stall_torque: 0", "stall_torque: must be positive"),
        ("voltage: 12.0", "voltage: 24.0", "voltage: 24 V is outside voltage_range 9.5..16 V"),
        ("[9.5, 16.0]", "[16.0, 9.5]", "voltage_range: upside down"),
        ("center_tick: 2048", "center_tick: 4096", "center_tick: 4096 is outside 0..4095"),
    ],
)
def test_a_servo_that_cannot_be_is_refused(tmp_path: Path, old: str, new: str, words: str) -> None:
    path, line = edited(tmp_path, "servos", "xm430-w350.yaml", old, new)
    with pytest.raises(ConfigError, match=re.escape(words)) as caught:
        load_servo(str(path))
    assert str(caught.value).startswith(f"{path}:{line}: "), caught.value


def test_a_robot_may_bring_its_own_servo_and_model(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Files beside the robot's own are found wherever the program was started."""
    edited(tmp_path, "robots", "op3.yaml", ROLL, ROLL.replace("servo: xm430-w350", "servo: strong.yaml"))
    strong = (CONFIGS / "servos" / "xm430-w350.yaml").read_text().replace("stall_torque: 2.95", "stall_torque: 5.0")
    monkeypatch.chdir(tmp_path)
    with pytest.raises(ConfigError, match=r"op3\.yaml:\d+: joints\[3\]\.servo: no file strong\.yaml in "):
        load_robot("op3.yaml")
    (tmp_path / "strong.yaml").write_text(strong.replace("stall_torque", "stahl_torque"))
    with pytest.raises(ConfigError, match=r"strong\.yaml:14: stahl_torque: unknown key; did you mean 'stall_torque'"):
        load_robot("op3.yaml")
    (tmp_path / "strong.yaml").write_text(strong)
    robot = load_robot("op3.yaml")
    monkeypatch.chdir("/")
    assert [servo.stall_torque for servo in robot.servos[2:5]] == [2.95, 5.0, 2.95]
    assert robot.mjcf == str(tmp_path / "op3.xml")


def test_a_saved_robot_is_the_same_robot_wherever_it_lies(tmp_path: Path) -> None:
    """Another process emulates the robot that this one holds, changes to it included."""
    robot = load_robot()
    bus = replace(robot.bus, baud=1_000_000)
    imu = replace(robot.imu, gyro_noise=1e-5, signs=(-1.0, 1.0, -1.0))
    joints = (replace(robot.joints[0], zero=0.1), *robot.joints[1:])
    for each in (robot, replace(robot, bus=bus, imu=imu, joints=joints)):
        save_robot(each, tmp_path / "saved.yaml")
        assert load_robot(tmp_path / "saved.yaml") == each


def test_a_saved_robot_finds_its_own_servo_file(tmp_path: Path) -> None:
    (tmp_path / "design").mkdir()
    text = (CONFIGS / "robots" / "op3.yaml").read_text().replace("xm430-w350", "mine.yaml")
    (tmp_path / "design" / "robot.yaml").write_text(text)
    for name, source in (
        ("mine.yaml", CONFIGS / "servos" / "xm430-w350.yaml"),
        ("op3.xml", CONFIGS / "robots" / "op3.xml"),
    ):
        (tmp_path / "design" / name).write_bytes(source.read_bytes())
    robot = load_robot(tmp_path / "design" / "robot.yaml")
    save_robot(robot, tmp_path / "saved.yaml")
    assert load_robot(tmp_path / "saved.yaml").servos == robot.servos


def test_what_a_robot_may_be_asked_is_derived_from_its_height(tmp_path: Path) -> None:
    """Alike robots walk alike: the OP3's figures come out for its height, and twice its speed for four times that."""
    text = (CONFIGS / "robots" / "op3.yaml").read_text()
    section = re.search(r"^walking:.*\n(  .*\n)+", text, re.MULTILINE)
    assert section

    copy(CONFIGS / "robots" / "op3.xml", tmp_path)

    def loaded(walking: str, height: float) -> Walking:
        path = tmp_path / "own.yaml"
        path.write_text(
            text.replace(section[0], walking).replace("standing_height: 0.259", f"standing_height: {height}")
        )
        return load_robot(path).walking

    op3, derived, small = load_robot().walking, loaded("", 0.25), loaded("", 0.0625)
    np.testing.assert_allclose(derived.upper, op3.upper, rtol=0.02)
    np.testing.assert_allclose(derived.lower, op3.lower, rtol=0.02)
    assert derived.height == 0.25
    assert derived.forward == pytest.approx(2 * small.forward)
    assert derived.turning == pytest.approx(0.5 * small.turning)
    part = loaded("walking: {forward: 0.4, sideways: 0.2}\n", 0.25)
    assert part.upper == pytest.approx([0.4, 0.2, 0.8])
    assert part.backward == pytest.approx(0.12)


def test_a_robot_that_is_saved_keeps_what_was_derived(tmp_path: Path) -> None:
    robot = replace(load_robot(), walking=Walking().derived(0.3))
    save_robot(robot, tmp_path / "robot.yaml")
    assert load_robot(tmp_path / "robot.yaml").walking == robot.walking

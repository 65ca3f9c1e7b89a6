"""The gait's steps, as a walking robot would notice if they were wrong."""

from __future__ import annotations

import itertools
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servoid.hw.config import CONFIGS, ConfigError
from servoid.hw.geometry import turned, up_vector, yaw_of
from servoid.hw.robot.description import load_robot
from servoid.hw.robot.inverse import NumericInverse
from servoid.hw.robot.legs import LegInverse, Legs
from servoid.policy.references.gait import Gait, GaitSettings, GyroFeedback, load_gait
from servoid.stack.control.fleet import Fleet
from servoid.stack.control.gait import GaitPolicy

ROBOT, SETTINGS = load_robot(), load_gait()
LEGS = Legs(ROBOT)
NOW = np.array([0])
PHASES = np.linspace(0, 1, 48, endpoint=False)
_GAIT = Gait(ROBOT)
BOX = np.array(list(itertools.product(*((low, 0.0, high) for low, high in zip(_GAIT.lower, _GAIT.upper, strict=True)))))


def pose(phase: np.ndarray, velocity: np.ndarray, activity: float = 1.0) -> tuple[np.ndarray, np.ndarray]:
    velocity = np.broadcast_to(velocity, (*phase.shape, 3))
    return Gait(ROBOT).pose(phase, velocity, np.full(phase.shape, activity))


def soles(phase: np.ndarray, velocity: np.ndarray) -> np.ndarray:
    """Centres of the soles `(..., n_legs, 3)`, upright frame, without the sway that both share."""
    centre, _ = LEGS.soles(LEGS.pick(pose(phase, velocity)[0]))
    lean = SETTINGS.lean - SETTINGS.backward_lean * min(velocity[0], 0.0)
    c, s = np.cos(lean), np.sin(lean)
    x, y, z = np.moveaxis(centre, -1, 0)
    return np.stack([c * x + s * z, y - SETTINGS.sway * np.sin(2 * np.pi * phase)[..., None], c * z - s * x], -1)


def test_joints_stay_within_the_limits_over_the_whole_command_box() -> None:
    phase, velocity = (a.reshape(-1, *a.shape[2:]) for a in (np.tile(PHASES, (27, 1)), np.repeat(BOX[:, None], 48, 1)))
    joints, _ = pose(phase, velocity)
    margin = ROBOT.limits.margin
    assert (joints > ROBOT.lower + margin).all()
    assert (joints < ROBOT.upper - margin).all()
    assert np.isfinite(joints).all()


def test_the_mirrored_command_gives_the_mirrored_steps() -> None:
    index, sign = ROBOT.mirror
    for velocity in BOX:
        joints, contact = pose(PHASES, velocity)
        mirrored, their_contact = pose((PHASES + 0.5) % 1.0, velocity * [1, -1, -1])
        np.testing.assert_allclose(mirrored, joints[:, index] * sign, atol=1e-9)
        np.testing.assert_array_equal(their_contact, contact[:, ::-1])


@pytest.mark.parametrize(
    ("velocity", "tolerance"),
    # A turning foot goes along the tangent of its circle: an error of the second order.
    [((0.3, 0.0, 0.0), 1e-3), ((-0.2, 0.1, 0.0), 1e-3), ((0.2, 0.05, 0.5), 0.03), ((0.0, 0.0, -0.8), 0.03)],
)
def test_standing_feet_stand_still_in_the_world(velocity: tuple[float, float, float], tolerance: float) -> None:
    """But for steps that are made longer because soft legs drag: those are tested below."""
    v, dt = np.array(velocity), 1e-4
    v[1] /= SETTINGS.sideways_gain  # what is asked so that the feet move with `velocity`
    v[0] /= SETTINGS.backward_gain if v[0] < 0 else 1.0
    step = dt / SETTINGS.cycle
    before, after = soles(PHASES, v), soles((PHASES + step) % 1.0, v)
    contact = pose(PHASES, v)[1] * pose((PHASES + step) % 1.0, v)[1]
    own = (after - before) / dt  # seen from the base, which goes with the twist
    v = np.array(velocity)
    carried = v[:2] + v[2] * np.stack([-before[..., 1], before[..., 0]], -1)
    slip = np.linalg.norm(own[..., :2] + carried, axis=-1)[contact > 0]
    assert slip.max() < tolerance
    assert np.abs(own[..., 2])[contact > 0].max() < 2e-3
    assert 0.55 < contact.mean() < 0.65  # a foot stands through 60 % of the cycle


def test_feet_turn_with_the_yaw_rate_and_stay_level() -> None:
    joints, contact = pose(PHASES, np.array([0.1, 0.0, 0.8]))
    _, rotation, _, _ = LEGS.forward(LEGS.pick(joints))
    c, s = np.cos(SETTINGS.lean), np.sin(SETTINGS.lean)
    level = np.array([[c, 0, s], [0, 1, 0], [-s, 0, c]]) @ rotation
    np.testing.assert_allclose(level[..., 2, 2], 1.0, atol=1e-9)
    yaw = np.arctan2(level[..., 1, 0], level[..., 0, 0])
    rate = np.diff(yaw, axis=0) / (SETTINGS.cycle / len(PHASES))
    standing = contact[1:] * contact[:-1] > 0
    np.testing.assert_allclose(rate[standing], -0.8, atol=1e-6)


def test_the_swinging_foot_is_lifted_and_only_one_swings() -> None:
    velocity = np.array([0.2, 0.0, 0.0])
    _, contact = pose(PHASES, velocity)
    height = soles(PHASES, velocity)[..., 2]
    ground = height[contact > 0].mean()
    np.testing.assert_allclose(height[contact > 0], ground, atol=5e-4)
    assert height.max() - ground == pytest.approx(SETTINGS.lift, abs=1e-3)
    assert contact.sum(-1).min() == 1


def walked(gait: Gait, velocity: np.ndarray, ticks: int) -> None:
    gait.command(velocity)
    for _ in range(ticks):
        gait.advance()


def test_it_stands_when_nothing_is_asked_and_again_after_a_walk() -> None:
    gait = Gait(ROBOT)
    stand = gait.frames(NOW)
    walked(gait, np.zeros(3), 50)
    np.testing.assert_array_equal(gait.frames(NOW).position, stand.position)
    assert stand.contact.min() == 1.0
    walked(gait, np.array([0.2, 0.05, 0.3]), 60)
    assert gait.activity == 1.0
    assert gait.frames(NOW).velocity[0] == pytest.approx([0.2, 0.05])
    walked(gait, np.zeros(3), 100)
    np.testing.assert_allclose(gait.frames(NOW).position, stand.position, atol=1e-12)
    assert not gait.velocity.any()


def test_the_foot_on_the_side_it_goes_to_takes_the_first_step() -> None:
    for velocity, foot in (([0.2, 0, 0], 0), ([0, 0.1, 0], 0), ([0, -0.1, 0], 1), ([0.1, 0, -0.5], 1)):
        for before in (0, 37):  # however long it walked and stood before
            gait = Gait(ROBOT)
            walked(gait, np.array([0.2, 0.0, 0.0]), before)
            walked(gait, np.zeros(3), 100)
            gait.command(np.array(velocity))
            while (contact := gait.frames(NOW).contact[0]).all():
                gait.advance()
            assert contact.tolist() == [float(foot != 0), float(foot != 1)]


def test_fast_steps_swing_evenly_so_that_joints_can_follow() -> None:
    """A smooth swing asks a hip for twice its mean speed."""

    def fastest(settings: GaitSettings, speed: float) -> float:
        gait = Gait(ROBOT, settings=settings)
        joints, _ = gait.pose(PHASES, np.tile([speed, 0.0, 0.0], (len(PHASES), 1)), np.ones(len(PHASES)))
        hips = joints[:, [ROBOT.names.index(f"{side}_hip_pitch") for side in "lr"]]
        return float(np.abs(np.diff(hips, axis=0)).max() * len(PHASES) / settings.cycle)

    smooth = replace(SETTINGS, even_swing=(8.0, 9.0))
    assert fastest(SETTINGS, 0.2) == fastest(smooth, 0.2)
    assert fastest(SETTINGS, SETTINGS.max_velocity[0]) < 0.9 * fastest(smooth, SETTINGS.max_velocity[0])


def test_velocity_is_slewed_and_clipped() -> None:
    gait, last = Gait(ROBOT), np.zeros(3)
    gait.command(np.array([9.0, -9.0, 9.0]))
    for _ in range(120):
        gait.advance()
        change = np.abs(gait.velocity - last)
        assert (change <= np.array(SETTINGS.acceleration) * ROBOT.dt + 1e-12).all()
        last = gait.velocity
    assert last == pytest.approx(np.array(SETTINGS.max_velocity) * [1, -1, 1])


def test_starting_and_stopping_asks_for_no_faster_joints_than_walking() -> None:
    gait, targets = Gait(ROBOT), []
    for velocity, ticks in ((np.array([0.3, 0.0, 0.0]), 100), (np.zeros(3), 100)):
        gait.command(velocity)
        for _ in range(ticks):
            targets.append(gait.frames(NOW).position[0])
            gait.advance()
    change = np.abs(np.diff(targets, axis=0)).max(-1)
    steady = change[50:99].max()
    assert change[:50].max() < 1.05 * steady
    assert change[99:].max() < 1.05 * steady
    assert not change[-20:].any()


def test_frames_ahead_are_what_comes() -> None:
    gait = Gait(ROBOT)
    walked(gait, np.array([0.2, 0.0, 0.4]), 80)
    ahead = gait.frames(np.array([0, 3, 8]))
    for _ in range(8):
        gait.advance()
    now = gait.frames(NOW)
    np.testing.assert_allclose(ahead.position[2], now.position[0], atol=1e-9)
    np.testing.assert_array_equal(ahead.contact[2], now.contact[0])
    assert ahead.height == pytest.approx(ROBOT.standing_height)


def test_the_root_goes_the_way_of_the_twist_from_where_it_is_now() -> None:
    """A tracker holds the robot's own way since now against it: an origin that moved on would be a drift."""
    gait = Gait(ROBOT)
    walked(gait, np.array([0.2, 0.1, 0.8]), 80)
    ticks = np.arange(60)
    frames = gait.frames(ticks)
    np.testing.assert_allclose(frames.root_position[0], [0, 0, ROBOT.standing_height], atol=1e-12)
    np.testing.assert_allclose(frames.root_position[:, 2], frames.height)
    heading = yaw_of(frames.root_orientation)
    np.testing.assert_allclose(heading, frames.yaw_rate * ticks * ROBOT.dt, atol=1e-9)
    steps = np.diff(frames.root_position[:, :2], axis=0) / ROBOT.dt  # a chord: it heads between its two ends
    np.testing.assert_allclose(turned(steps, -(heading[1:] + heading[:-1]) / 2), frames.velocity[1:], atol=1e-4)
    up = up_vector(frames.root_orientation)  # leaning forward, the base sees up behind
    np.testing.assert_allclose(up, np.tile([-np.sin(SETTINGS.lean), 0, np.cos(SETTINGS.lean)], (60, 1)), atol=1e-12)


def test_a_straight_walk_is_no_division_by_zero_and_standing_stays() -> None:
    gait = Gait(ROBOT, (2,))
    walked(gait, np.array([[0.2, 0.0, 0.0], [0.0, 0.0, 0.0]]), 80)
    frames = gait.frames(np.array([0, 50]))
    np.testing.assert_allclose(frames.root_position[:, 1, :2], [[0.2, 0], [0, 0]], atol=1e-12)
    assert not frames.joint_velocity[1].any()
    assert gait.ended.tolist() == [False, False]


def test_joint_velocity_leads_from_frame_to_frame() -> None:
    gait = Gait(ROBOT)
    walked(gait, np.array([0.3, 0.0, 0.4]), 80)
    frames = gait.frames(np.arange(10))
    np.testing.assert_allclose(np.diff(frames.position, axis=0) / ROBOT.dt, frames.joint_velocity[:-1], atol=1e-9)
    assert np.abs(frames.joint_velocity).max() > 1.0


def test_many_worlds_walk_as_one_robot_does_and_reset_alone() -> None:
    commands = np.array([[0.2, 0.0, 0.0], [0.0, 0.1, 0.5], [0.0, 0.0, 0.0]])
    many = Gait(ROBOT, (3,))
    walked(many, commands, 37)
    for i in range(3):
        one = Gait(ROBOT)
        walked(one, commands[i], 37)
        np.testing.assert_allclose(many.frames(NOW).position[i], one.frames(NOW).position, atol=1e-12)
    many.reset(np.array([0]))
    assert not many.velocity[0].any()
    assert many.velocity[1].any()


def test_gyro_feedback_turns_both_ankles_the_same_way_in_space() -> None:
    """A body that pitches forward gets its toes pressed down: both feet pitch further than the body asks."""
    feedback, home = GyroFeedback(ROBOT), ROBOT.home
    for axis in (0, 1):
        rate = np.zeros(3)
        rate[axis] = 1.0
        _, level, _, _ = LEGS.forward(LEGS.pick(home))
        _, turned, _, _ = LEGS.forward(LEGS.pick(feedback(home, rate)))
        turn = turned @ np.swapaxes(level, -1, -2)
        skew = 0.5 * (turn - np.swapaxes(turn, -1, -2))
        vector = np.stack([skew[:, 2, 1], skew[:, 0, 2], skew[:, 1, 0]], -1)
        assert vector[:, axis] == pytest.approx([0.05, 0.05], abs=3e-3)
    np.testing.assert_array_equal(feedback(home, np.zeros(3)), home)


@pytest.mark.parametrize(
    ("part", "joint", "change", "said"),
    [
        ("offset", 1, (0.0, 0.02, 0.0), "meet in a point"),
        ("offset", 2, (0.02, 0.0, 0.0), "meet in a point"),
        ("offset", 5, (0.0, 0.0, -0.02), "meet in a point"),
        ("axis", 0, (0.0, 0.5, 0.134), "not along the base's axes"),
    ],
)
def test_legs_that_the_analytic_inverse_does_not_hold_for_are_refused_by_it(
    part: str, joint: int, change: tuple[float, float, float], said: str
) -> None:
    """It would be silently wrong: by 18 mm for an axis that is tilted by 30 degrees."""
    legs = Legs(ROBOT)
    changed = getattr(legs, part).copy()
    changed[:, joint] += change
    setattr(legs, part, changed)
    with pytest.raises(ConfigError, match=said):
        LegInverse(legs, "own")


def test_the_numeric_inverse_takes_the_gaits_steps_as_the_analytic_one_does() -> None:
    joints, _ = pose(PHASES, np.array([0.3, 0.05, 0.3]))
    legs, numeric, analytic = Legs(ROBOT), NumericInverse(ROBOT, Legs(ROBOT)), LegInverse(Legs(ROBOT), "op3")
    at, turn, _, _ = legs.forward(legs.pick(joints))
    np.testing.assert_allclose(numeric(at, turn), legs.pick(joints), atol=3e-4)  # it leans toward home a little
    ankle = at + np.einsum("...ij,...j->...i", turn, analytic.ankle)
    np.testing.assert_allclose(analytic(ankle, turn), legs.pick(joints), atol=1e-3)


@pytest.mark.parametrize(
    ("changes", "joints"),
    [
        (
            [
                ('<body name="l_knee_link" pos="0 0', '<body name="l_knee_link" pos="0.01 0'),
                ('<body name="r_knee_link" pos="0 0', '<body name="r_knee_link" pos="0.01 0'),
            ],
            6,
        ),
        (
            [
                ('<joint name="l_hip_yaw" axis="0 0 -1"', '<joint name="l_hip_yaw" axis="0 -0.5 -0.866"'),
                ('<joint name="r_hip_yaw" axis="0 0 -1"', '<joint name="r_hip_yaw" axis="0 0.5 -0.866"'),
            ],
            6,
        ),
        (
            [
                ('        <joint name="l_hip_yaw" axis="0 0 -1"/>', ""),
                ('        <joint name="r_hip_yaw" axis="0 0 -1"/>', ""),
            ],
            5,
        ),
        (
            [
                ('                  <joint name="l_ank_roll" axis="1 0 0"/>', ""),
                ('                  <joint name="r_ank_roll" axis="1 0 0"/>', ""),
            ],
            5,
        ),
    ],
    ids=["knee-forward", "yaw-tilted", "no-yaw", "no-ankle-roll"],
)
def test_legs_of_another_build_take_the_same_steps(tmp_path: Path, changes: list[tuple[str, str]], joints: int) -> None:
    """As far as they can: without a yaw, or a roll at the ankle, feet still go where they should and do not pitch."""
    text, source = Path(ROBOT.mjcf).read_text(), (CONFIGS / "robots" / "op3.yaml").read_text()
    for old, new in changes:
        assert text.count(old) == 1
        text = text.replace(old, new)
    gone = [name for name in ROBOT.names if f'name="{name}"' not in text]
    source = "\n".join(row for row in source.splitlines() if not any(f"name: {name}," in row for name in gone))
    (tmp_path / "op3.xml").write_text(text)
    (tmp_path / "op3.yaml").write_text(source)
    robot = load_robot(tmp_path / "op3.yaml")
    assert robot.leg_index.shape == (2, joints)
    velocity = np.broadcast_to([0.2, 0.0, 0.0], (len(PHASES), 3))
    legs, gait = Legs(robot), Gait(robot)
    assert isinstance(gait._inverse, NumericInverse)
    pose, _ = gait.pose(PHASES, velocity, np.ones(len(PHASES)))
    own, _ = Gait(ROBOT).pose(PHASES, velocity, np.ones(len(PHASES)))
    here, there = legs.soles(legs.pick(pose))[0], LEGS.soles(LEGS.pick(own))[0]
    np.testing.assert_allclose(np.ptp(here, axis=0)[:, [0, 2]], np.ptp(there, axis=0)[:, [0, 2]], atol=2e-3)
    turn = legs.forward(legs.pick(pose))[1]
    pitch = np.arctan2(-turn[..., 2, 0], turn[..., 0, 0])
    np.testing.assert_allclose(pitch, pitch.mean(), atol=0.01)


def test_arms_are_found_by_geometry(tmp_path: Path) -> None:
    for name in ("op3.xml", "op3.yaml"):
        text = (CONFIGS / "robots" / name).read_text()
        (tmp_path / name).write_text(text.replace("l_sho_pitch", "l_swing").replace("r_sho_pitch", "r_swing"))
    robot = load_robot(tmp_path / "op3.yaml")
    assert ROBOT.arms == {"l_sho_pitch": 1.0, "r_sho_pitch": 1.0}
    assert robot.arms == {"l_swing": 1.0, "r_swing": 1.0}
    np.testing.assert_array_equal(walked(Gait(robot), FORWARD, 30), walked(Gait(ROBOT), FORWARD, 30))


FORWARD = np.array([0.3, 0.0, 0.0])


@pytest.mark.slow
def test_it_walks_five_seconds_on_the_nominal_robot() -> None:
    commands = np.array([[0.2, 0, 0], [-0.1, 0, 0], [0, 0.08, 0], [0.1, -0.05, 0], [0.1, 0, 0.5], [0, 0, -0.8]])
    fleet = Fleet(ROBOT, len(commands), None, seed=4, threads=1)
    policy = GaitPolicy(ROBOT, (fleet.n,))
    fleet.reset(np.ones(fleet.n, bool))
    turned, heading = np.zeros(len(commands)), fleet.truth.yaw
    for _ in range(250):
        fleet.drive(policy, commands)
        turned += (fleet.truth.yaw - heading + np.pi) % (2 * np.pi) - np.pi
        heading = fleet.truth.yaw
        assert not fleet.truth.fallen.any()
    x, y = fleet.truth.position[:, 0], fleet.truth.position[:, 1]
    assert x[0] > 0.5  # half of what was asked, at least: nothing corrects its slip
    assert x[0] - x[1] > 0.5
    assert y[2] - y[3] > 0.2
    assert turned[4] > 1.0
    assert turned[5] < -0.5


def test_what_a_faster_gait_adds_is_nothing_to_one_that_does_not_ask_for_it() -> None:
    walk = np.array([0.45, 0.0, 0.0])
    lower = replace(SETTINGS, lift_loss=0.02)
    for velocity, same in ((np.array([0.2, 0.0, 0.5]), True), (walk, False)):
        poses = [
            Gait(ROBOT, settings=each).pose(PHASES, np.tile(velocity, (48, 1)), np.ones(48))[0]
            for each in (SETTINGS, lower)
        ]
        assert np.array_equal(*poses) == same, "steps are lower at speed alone"
    gait = Gait(ROBOT)
    assert gait.led(ROBOT.home) is ROBOT.home


def test_joints_that_turn_the_feet_and_no_others_go_ahead_of_the_gait() -> None:
    gait = Gait(ROBOT, settings=replace(SETTINGS, yaw_lead=0.05))
    gait.command(np.array([0.0, 0.0, 1.0]))
    for _ in range(60):
        gait.advance()
    frames = gait.frames(np.arange(2))
    added = gait.led(frames.position[0]) - frames.position[0]
    yaws = np.array([name.endswith("hip_yaw") for name in ROBOT.names])
    assert added[~yaws] == pytest.approx(0.0)
    assert added[yaws] == pytest.approx(0.05 * (frames.position[1] - frames.position[0])[yaws] / ROBOT.dt)
    assert np.abs(added[yaws]).max() > 0.01

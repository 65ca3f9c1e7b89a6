"""Which way is up, and how much the robot has turned, from a biased gyro and a shaken accelerometer."""

from __future__ import annotations

import itertools

import numpy as np
import pytest

from servoid.hw.contracts.control import Instruction
from servoid.hw.geometry import rotate, up_vector, yaw_of
from servoid.hw.robot.description import load_robot
from servoid.stack.control.fleet import Fleet
from servoid.stack.control.gait import GaitPolicy
from servoid.stack.estimation.attitude import Attitude

DT = 0.02
LEVEL = np.array([0.0, 0.0, 9.81])
STILL = np.zeros(20)
MOVING = np.full(20, 1.0)


def started(force: np.ndarray = LEVEL, bias: np.ndarray | None = None) -> Attitude:
    attitude = Attitude(DT)
    attitude.reset(np.array(True), force, bias)
    return attitude


def test_it_starts_where_the_accelerometer_says_is_up_heading_zero() -> None:
    for force in np.random.default_rng(0).standard_normal((20, 3)) * 9.81:
        attitude = started(force)
        np.testing.assert_allclose(up_vector(attitude.quaternion), force / np.linalg.norm(force), atol=1e-9)
        assert yaw_of(attitude.quaternion) == pytest.approx(0.0, abs=1e-9)


def test_it_starts_on_its_head_and_without_an_accelerometer() -> None:
    np.testing.assert_allclose(up_vector(started(-LEVEL).quaternion), [0, 0, -1], atol=1e-9)
    for nothing in (np.zeros(3), np.full(3, np.nan)):
        np.testing.assert_allclose(up_vector(started(nothing).quaternion), [0, 0, 1])


def test_turns_add_up_over_whole_turns() -> None:
    attitude, turn = started(), np.array([0.0, 0.0, 2.0])
    for _ in range(500):  # 20 rad: more than three turns
        attitude.update(turn, LEVEL, MOVING)
    assert attitude.yaw == pytest.approx(20.0, rel=1e-3)
    np.testing.assert_allclose(up_vector(attitude.quaternion), [0, 0, 1], atol=1e-6)


def test_axes_are_those_of_the_base() -> None:
    """Pitching forward by the gyro brings the x axis down, and up is then seen backwards."""
    attitude = started()
    for _ in range(25):
        attitude.update(np.array([0.0, 1.0, 0.0]), np.full(3, np.nan), MOVING)
    np.testing.assert_allclose(up_vector(attitude.quaternion), [-np.sin(0.5), 0, np.cos(0.5)], atol=1e-3)
    forward = rotate(attitude.quaternion, np.array([1.0, 0.0, 0.0]))
    np.testing.assert_allclose(forward, [np.cos(0.5), 0, -np.sin(0.5)], atol=1e-3)


def test_the_accelerometer_corrects_the_tilt_but_not_when_it_is_shaken() -> None:
    def tilt_left(scale: float) -> float:
        attitude = started(np.array([9.81 * np.sin(0.2), 0.0, 9.81 * np.cos(0.2)]))
        for _ in range(100):
            attitude.update(np.zeros(3), LEVEL * scale, MOVING)
        return float(np.arccos(up_vector(attitude.quaternion)[2]))

    assert tilt_left(1.0) == pytest.approx(0.2 * np.exp(-0.5 * 2.0), rel=0.05)
    assert tilt_left(2.0) > 0.18  # 2 g is no gravity


@pytest.mark.slow
def test_the_gyros_bias_is_learned_while_standing_and_kept_while_moving() -> None:
    bias, noise = np.array([0.01, -0.02, 0.015]), np.random.default_rng(1)
    attitude = started()
    for _ in range(150):
        attitude.update(bias + 0.003 * noise.standard_normal(3), LEVEL, STILL)
    np.testing.assert_allclose(attitude.bias, bias, atol=1e-3)
    learned, before = attitude.bias.copy(), attitude.yaw
    for _ in range(3000):  # a minute of moving, during which nothing is learned
        rate = attitude.update(bias + 0.003 * noise.standard_normal(3), LEVEL, MOVING)
    np.testing.assert_array_equal(attitude.bias, learned)
    assert np.abs(rate).max() < 0.02
    assert abs(attitude.yaw - before) < 0.05


def test_a_slow_turn_on_quiet_joints_is_not_taken_for_bias() -> None:
    attitude = started()
    for _ in range(200):
        attitude.update(np.array([0.0, 0.0, 0.3]), LEVEL, STILL)
    assert not attitude.bias.any()
    assert attitude.yaw == pytest.approx(1.2, rel=1e-3)


def test_a_bias_that_is_known_is_not_thrown_away_for_one_sample() -> None:
    attitude = started(bias=np.array([0.0, 0.0, 0.01]))
    for _ in range(17):
        attitude.update(np.array([0.0, 0.0, 0.04]), LEVEL, STILL)
    assert 0.01 < attitude.bias[2] < 0.011


def test_what_was_not_read_coasts() -> None:
    attitude = started(bias=np.array([0.0, 0.0, 0.01]))
    attitude.update(np.array([0.0, 0.0, 0.5]), LEVEL, MOVING)
    yaw, nothing = attitude.yaw, np.full(3, np.nan)
    for _ in range(20):
        attitude.update(nothing, nothing, np.full(20, np.nan))
    assert attitude.yaw == yaw
    assert np.isfinite(attitude.quaternion).all()
    assert attitude.bias.tolist() == [0.0, 0.0, 0.01]
    attitude.update(np.array([0.0, 0.0, 0.51]), nothing, MOVING)  # the gyro alone goes on
    assert attitude.yaw == pytest.approx(yaw + 0.01, abs=1e-6)


def test_a_turn_goes_on_in_ticks_that_were_missed() -> None:
    whole, gaps, turn = started(), started(), np.array([0.0, 0.0, 0.5])
    for _ in range(30):
        whole.update(turn, LEVEL, MOVING)
    for ticks in (1, 3) * 7 + (2,):
        gaps.update(turn, LEVEL, MOVING, ticks=ticks)
    assert gaps.yaw == pytest.approx(whole.yaw, rel=1e-3)


def test_worlds_are_independent_and_reset_alone() -> None:
    many, rng = Attitude(DT, (3,)), np.random.default_rng(2)
    singles = [Attitude(DT) for _ in range(3)]
    for tick in range(60):
        gyro, force = rng.standard_normal((3, 3)), LEVEL + rng.standard_normal((3, 3))
        if tick == 30:
            many.reset(np.array([False, True, False]), force)
            singles[1].reset(np.array(True), force[1])
        many.update(gyro, force, np.tile(MOVING, (3, 1)))
        for i, single in enumerate(singles):
            single.update(gyro[i], force[i], MOVING)
            np.testing.assert_allclose(many.quaternion[i], single.quaternion, atol=1e-12)
            assert many.yaw[i] == pytest.approx(single.yaw)


@pytest.mark.slow
def test_gravity_and_heading_hold_while_it_walks() -> None:
    robot = load_robot()
    fleet = Fleet(robot, 6, None, seed=1, threads=1)
    policy = GaitPolicy(robot, (6,))
    fleet.reset(np.ones(6, bool))
    command = np.array([[0.2, 0, 0], [0.1, 0.05, 0], [0, 0, 0.5], [0.15, 0, -0.5], [0, -0.08, 0], [-0.1, 0, 0]])
    for _ in range(25):  # a reset drops the robot on its feet: as in a run, up is taken when it stands
        fleet.observe()
        fleet.step(fleet.applied)
    fleet.estimator.reset()
    errors = []
    for _ in range(500):
        state = fleet.observe()
        upright = (state.gravity * fleet.truth.gravity).sum(-1)
        errors.append(np.arccos(np.clip(upright, -1, 1)))
        fleet.step(policy.act(state, fleet.applied, Instruction(command)))
        assert not fleet.truth.fallen.any()
    heading = (fleet.observe().yaw - fleet.truth.yaw + np.pi) % (2 * np.pi) - np.pi
    assert np.sqrt(np.mean(np.square(errors))) < 0.03
    assert np.abs(heading).max() < 0.1 * 10 / 60 + 0.01  # 0.1 rad a minute, and a tick's latency


def test_the_creep_of_a_standing_robot_is_not_taken_for_the_gyros_bias() -> None:
    attitude, bias, creep = started(), np.array([0.01, -0.012, 0.004]), np.array([0.0, 0.03, 0.0])
    rng = np.random.default_rng(0)
    ticks = rng.normal(0.0, 0.001, (151, 3))  # rad: the legs' angles come in steps
    for before, after in itertools.pairwise(ticks):
        attitude.update(bias + creep, LEVEL, STILL, creep + (after - before) / DT)
    np.testing.assert_allclose(attitude.bias, bias, atol=0.002)


def test_a_robot_that_lies_learns_no_bias_and_keeps_the_one_it_knows() -> None:
    """Still on the ground it may be turned slowly by whatever lies on it."""
    attitude = Attitude(0.02)
    upright, still = np.array([0.0, 0.0, 9.81]), np.zeros(20)
    for _ in range(100):
        attitude.update(np.array([0.02, 0.0, 0.0]), upright, still)
    known = attitude.bias.copy()
    assert known[0] == pytest.approx(0.02, abs=1e-6)
    attitude.learns = False
    for _ in range(200):
        attitude.update(np.array([0.05, 0.0, 0.0]), upright, still)
    attitude.level(upright, attitude.yaw + 4.0 * np.pi)
    np.testing.assert_array_equal(attitude.bias, known)
    assert float(attitude.yaw) == pytest.approx(4.0 * np.pi, abs=0.1)

"""Floating, jerk and slip are what they are said to be, on motions whose figures are known."""

from __future__ import annotations

import numpy as np
import pytest

from servoid.hw.robot.description import load_robot
from servoid.hw.robot.legs import Legs
from servoid.sim.backend import SimBackend
from servoid.tools.common.motion_quality import PLANTED, Poses, floating, foot_slip, jerk, quality, rotations

DT = 0.02


def soles(heights: list[float], speed: float = 0.0) -> np.ndarray:
    """Corners `(ticks, 2, 4, 3)` of two level soles; the first one is at `heights` and moves along x, the second one is
    high above the ground."""
    square = np.array([[0.05, 0.03, 0], [0.05, -0.03, 0], [-0.05, 0.03, 0], [-0.05, -0.03, 0]])
    corners = np.zeros((len(heights), 2, 4, 3)) + square
    corners[:, 0, :, 2] += np.array(heights)[:, None]
    corners[:, 0, :, 0] += (speed * DT * np.arange(len(heights)))[:, None]
    corners[:, 1, :, 2] = 0.5
    return corners


def test_floating_is_the_mean_height_of_the_lowest_sole_and_sinking_in_is_none() -> None:
    assert floating(soles([0.01, 0.03, -0.02, 0.0])) == pytest.approx(0.01)


def test_jerk_of_a_cubic_is_its_third_derivative() -> None:
    t = DT * np.arange(20)
    places = np.stack([2.0 * t**3, np.zeros_like(t), 5.0 * t**2], -1)[:, None]
    assert jerk(places, DT) == pytest.approx(12.0)
    assert np.isnan(jerk(places[:3], DT))


def test_only_a_sole_that_stands_on_the_ground_slips() -> None:
    assert foot_slip(soles([0.0] * 10, speed=0.1), DT) == pytest.approx(0.1)
    assert foot_slip(soles([0.0] * 10), DT) == 0.0
    swinging = soles([2 * PLANTED] * 10, speed=0.5)
    assert np.isnan(foot_slip(swinging, DT))
    tipped = soles([0.0] * 10, speed=0.5)
    tipped[:, 0, 0, 2] = 2 * PLANTED  # on its edge: it rolls, and does not slip
    assert np.isnan(foot_slip(tipped, DT))


def test_rotations_agree_with_the_simulation() -> None:
    backend = SimBackend(load_robot(), seed=0)
    truth = backend.truth
    rng = np.random.default_rng(0)
    for _ in range(20):
        quaternion = rng.normal(size=4)
        truth.qpos[0, 3:7] = quaternion / np.linalg.norm(quaternion)
        w, x, y, z = truth.qpos[0, 3:7]
        expected = np.array(
            [
                [1 - 2 * (y * y + z * z), 2 * (x * y - w * z), 2 * (x * z + w * y)],
                [2 * (x * y + w * z), 1 - 2 * (x * x + z * z), 2 * (y * z - w * x)],
                [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)],
            ]
        )
        np.testing.assert_allclose(rotations(truth.yaw, -truth.gravity)[0], expected, atol=1e-9)


def test_a_robot_that_stands_neither_floats_nor_slips_and_one_in_the_air_floats() -> None:
    robot = load_robot()
    n = 10
    height, (w, x, y, z) = Legs(robot).stand(robot.home)
    up = [2 * (x * z - w * y), 2 * (y * z + w * x), 1 - 2 * (x * x + y * y)]
    position = np.tile([0.3, -0.2, height], (n, 1))
    poses = Poses(DT, position, np.full(n, 0.7), np.tile(up, (n, 1)), np.tile(robot.home, (n, 1)))
    still = quality(poses, robot)
    assert still["floating_mm"] == pytest.approx(0.0, abs=0.5)
    assert still["jerk_mps3"] == pytest.approx(0.0, abs=1e-6)
    assert still["foot_slip_mmps"] == pytest.approx(0.0, abs=1e-9)
    lifted = Poses(DT, position + np.array([0.0, 0.0, 0.05]), poses.yaw, poses.up, poses.joints)
    assert quality(lifted, robot)["floating_mm"] == pytest.approx(still["floating_mm"] + 50.0, abs=0.5)


def test_a_run_that_never_began_has_no_figures() -> None:
    empty = Poses(DT, np.zeros((0, 3)), np.zeros(0), np.zeros((0, 3)), np.zeros((0, 20)))
    assert all(np.isnan(value) for value in quality(empty, load_robot()).values())

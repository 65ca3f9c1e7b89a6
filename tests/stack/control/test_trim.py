"""The slow correction of what is asked of a planner."""

from __future__ import annotations

from types import SimpleNamespace
from typing import Any

import numpy as np

from servoid.hw.robot.description import load_robot
from servoid.stack.control.planning.trim import Trim

ROBOT = load_robot()
DT = ROBOT.dt


def state(velocity: Any) -> Any:
    velocity = np.asarray(velocity, dtype=float)
    flat = np.zeros_like(velocity[..., :1])
    planar = np.concatenate([velocity[..., :2], flat], -1)
    return SimpleNamespace(velocity=planar, angular_velocity=np.concatenate([flat, flat, velocity[..., 2:]], -1))


def test_a_robot_that_goes_too_fast_comes_to_what_was_asked() -> None:
    """A body that does 1.2 times what it is told, and sways as a walk does."""
    trim, asked = Trim(ROBOT, 1.0), np.array([0.2, 0.0, 0.5])
    went, told = [], np.zeros(3)
    for tick in range(400):
        sway = 0.1 * np.sin(2 * np.pi * tick / 24) * np.array([0.0, 1.0, 1.0])
        told = trim(state(1.2 * told + sway), asked)
        went.append(1.2 * told)
    np.testing.assert_allclose(np.mean(went[-24:], 0), asked, atol=0.01)
    assert went[10][0] > 0.23  # not before it is known


def test_it_begins_anew_when_something_else_is_asked_and_leaves_standing_alone() -> None:
    trim = Trim(ROBOT, 1.0)
    for _ in range(100):
        told = trim(state([0.3, 0.0, 0.0]), np.array([0.2, 0.0, 0.0]))
    assert told[0] < 0.15
    np.testing.assert_array_equal(trim(state([0.3, 0.0, 0.0]), np.array([0.0, 0.1, 0.0])), [0.0, 0.1, 0.0])
    for _ in range(100):
        told = trim(state([0.02, 0.0, 0.1]), np.zeros(3))
        np.testing.assert_array_equal(told, np.zeros(3))


def test_a_robot_that_is_stuck_is_not_asked_for_ever_more() -> None:
    trim = Trim(ROBOT, 1.0)
    for _ in range(2000):
        told = trim(state(np.zeros(3)), np.array([0.2, 0.0, 0.5]))
    np.testing.assert_allclose(told, [0.28, 0.0, 0.8])


def test_many_robots_are_corrected_as_one_is() -> None:
    rng = np.random.default_rng(0)
    asked, many = np.array([[0.2, 0.0, 0.0], [0.0, 0.0, 0.6]]), Trim(ROBOT, 1.0, (2,))
    ones = [Trim(ROBOT, 1.0), Trim(ROBOT, 1.0)]
    for tick in range(120):
        if tick == 60:
            asked = np.array([[0.2, 0.0, 0.0], [0.1, 0.0, 0.0]])
        measured = rng.normal(0.1, 0.1, (2, 3))
        together = many(state(measured), asked)
        for i in range(2):
            np.testing.assert_allclose(ones[i](state(measured[i]), asked[i]), together[i])


def test_one_of_many_robots_begins_anew_alone() -> None:
    asked, trim = np.tile([0.2, 0.0, 0.0], (2, 1)), Trim(ROBOT, 1.0, (2,))
    for _ in range(100):
        told = trim(state(np.tile([0.3, 0.0, 0.0], (2, 1))), asked)
    trim.reset(np.array([True, False]))
    after = trim(state(np.tile([0.3, 0.0, 0.0], (2, 1))), asked)
    np.testing.assert_allclose(after[0], asked[0])
    assert after[1, 0] <= told[1, 0] < 0.15

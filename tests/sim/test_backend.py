"""The simulated body keeps the contract of every body: nothing moves but by time, and time passes only by sleeping."""

from __future__ import annotations

import numpy as np
import pytest

from servoid.hw.contracts.body import Command, Mode
from servoid.hw.robot.description import load_robot
from servoid.sim.backend import SimBackend

ROBOT = load_robot()
TICK = 20_000_000  # ns
ONES = np.ones(20)


def test_time_and_the_body_advance_only_by_sleeping() -> None:
    body = SimBackend(ROBOT)
    before = body.qpos.copy()
    sensors, motors = body.connect()
    for _ in range(3):
        assert sensors.read().time_ns == body.clock.now_ns() == 0
        motors.write(Command(ROBOT.home + 0.3, ONES, Mode.ACTIVE))
    body.clock.sleep_until(TICK - 1)  # not a whole tick yet
    body.clock.sleep_until(-5)
    np.testing.assert_array_equal(body.qpos, before)
    body.clock.sleep_until(3 * TICK)
    assert sensors.read().time_ns == body.clock.now_ns() == 3 * TICK
    assert not np.array_equal(body.qpos, before)


def test_it_stands_at_home_with_torque_off_until_it_is_told_otherwise() -> None:
    body = SimBackend(ROBOT)
    sensors, _ = body.connect()
    observation = sensors.read()
    np.testing.assert_allclose(observation.position, ROBOT.home, atol=2e-3)
    assert observation.position.shape == (20,)
    assert observation.specific_force.shape == (3,)
    body.clock.sleep_until(5 * TICK)
    assert not sensors.read().effort.any()
    body.clock.sleep_until(50 * TICK)
    assert body.truth.position[0, 2] < 0.8 * ROBOT.standing_height  # nothing holds it


def test_a_command_is_taken_as_it_was_written() -> None:
    target, runs = ROBOT.home.copy(), []
    for change in (0.0, 1.0):
        body = SimBackend(ROBOT)
        _, motors = body.connect()
        goal = target.copy()
        motors.write(Command(goal, ONES, Mode.ACTIVE))
        goal += change  # the caller's array is the caller's
        body.clock.sleep_until(5 * TICK)
        runs.append(body.qpos.copy())
    np.testing.assert_array_equal(*runs)


def test_closing_leaves_torque_off() -> None:
    body = SimBackend(ROBOT)
    sensors, motors = body.connect()
    motors.write(Command(ROBOT.home, ONES, Mode.ACTIVE))
    body.clock.sleep_until(10 * TICK)
    assert np.abs(sensors.read().effort).max() > 0.1
    body.close()
    body.close()  # twice is no harm
    body.clock.sleep_until(12 * TICK)
    assert not sensors.read().effort.any()


def test_the_seed_draws_the_robot() -> None:
    def drawn(seed: int, randomise: bool) -> np.ndarray:
        body = SimBackend(ROBOT, seed=seed, randomise=randomise)
        sensors, motors = body.connect()
        motors.write(Command(ROBOT.home, ONES, Mode.ACTIVE))
        body.clock.sleep_until(20 * TICK)
        return np.concatenate([body.qpos, sensors.read().angular_velocity])

    np.testing.assert_array_equal(drawn(3, True), drawn(3, True))
    assert not np.array_equal(drawn(3, True), drawn(4, True))
    np.testing.assert_array_equal(drawn(3, False)[:-3], drawn(4, False)[:-3])  # the nominal body is one and the same
    assert not np.array_equal(drawn(3, False)[-3:], drawn(4, False)[-3:])  # but no two IMUs are


def test_a_push_is_a_change_of_velocity() -> None:
    body = SimBackend(ROBOT)
    body.push(np.array([0.1, -0.2]))
    assert body.truth.velocity[0, :2] == pytest.approx([0.1, -0.2])

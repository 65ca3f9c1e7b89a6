"""Upright at home until the task begins: soft servos with wrong zeros let the robot fall there."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fake_body import StillEstimator, observation

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import up_vector
from servoid.hw.robot.description import load_robot
from servoid.hw.robot.legs import Legs
from servoid.stack.runtime.run import RunSettings, run
from servoid.stack.safety.phase import Phase
from servoid.stack.safety.upright import MOST, Upright

ROBOT = load_robot()
UPRIGHT = -up_vector(Legs(ROBOT).stand(ROBOT.home)[1])
TOES_DOWN = {"l_ank_pitch": -1.0, "r_ank_pitch": 1.0}
STEP = ROBOT.limits.homing_speed * ROBOT.dt


def held(pitch: float, ticks: int = 100, robot=ROBOT) -> list[Array]:
    """Goals, less home, of a base that stays tilted forward by `pitch` rad from where it is at home."""
    cos, sin = np.cos(pitch), np.sin(pitch)
    gravity = np.array([cos * UPRIGHT[0] - sin * UPRIGHT[2], 0.0, sin * UPRIGHT[0] + cos * UPRIGHT[2]])
    state = replace(StillEstimator(robot).update(observation(robot, 0, robot.home), robot.home), gravity=gravity)
    upright, goals = Upright(robot), [robot.home]
    for _ in range(ticks):
        goals.append(upright.goal(state, goals[-1]))
    return [goal - robot.home for goal in goals]


def test_ankles_answer_a_tilt_slowly_and_what_they_answer_does_not_wind_up():
    """On a slope the tilt stays, however the joints answer it."""
    goals = held(0.1)
    assert np.abs(np.diff(goals, axis=0)).max() <= STEP + 1e-12
    np.testing.assert_array_equal(goals[-1], goals[-50])
    answer = {name: float(x) for name, x in zip(ROBOT.names, goals[-1], strict=True) if x}
    assert answer == pytest.approx({name: 0.05 * sign for name, sign in TOES_DOWN.items()}, abs=1e-3)
    back = dict(zip(ROBOT.names, held(-0.1)[-1], strict=True))
    assert back["l_ank_pitch"] > 0.0 > back["r_ank_pitch"]


def test_the_answer_is_bounded_and_who_is_held_askew_or_lies_gets_none():
    assert np.abs(held(-0.4)[-1]).max() == pytest.approx(MOST)
    assert np.abs(held(1.4)[-1]).max() == 0.0


def test_a_robot_that_does_not_feel_how_it_tilts_stays_at_home():
    blind = replace(ROBOT, imu=replace(ROBOT.imu, kind="none"))
    assert np.abs(held(0.1, robot=blind)[-1]).max() == 0.0


@pytest.mark.parametrize("seed", [9088, 9102])
def test_a_soft_robot_with_wrong_zeros_stands_until_its_task_begins(seed):
    """At 5.2 N m/rad these leant back by 50 and 66 degrees in the second and a half before it."""
    seen = []
    settings = RunSettings("stand", policy="gait", randomise=True, seed=seed, seconds=0.02)
    run(settings, on_tick=seen.append)
    ready = [record for record in seen if record.phase is Phase.READY]
    assert len(ready) == 75
    lean = [np.arctan2(record.state.gravity[0], -record.state.gravity[2]) for record in ready]
    assert np.degrees(np.abs(lean).max()) < 8.0  # 6 at home, and 1 that the IMU may be off

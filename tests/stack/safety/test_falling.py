"""A fall that is certain, before the limit of tilt; no false alarm for what only leans; lying without a tilt."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fake_body import StillEstimator, observation

from servoid.hw.contracts.control import State
from servoid.hw.robot.description import load_robot
from servoid.hw.robot.legs import Legs
from servoid.stack.safety.falling import AHEAD, LOST, Falling, tipping

ROBOT = load_robot()
STANDING = StillEstimator(ROBOT).update(observation(ROBOT, 0, ROBOT.home), ROBOT.home)


def leaning(tilt: float, rate: float, bearing: float = 0.0) -> State:
    """Tilted toward a bearing [rad], and tilting on at a rate [rad/s]."""
    axis = np.array([-np.sin(bearing), np.cos(bearing), 0.0])  # about which it tips
    way = np.array([np.cos(bearing), np.sin(bearing), 0.0])
    gravity = np.sin(tilt) * way + np.array([0.0, 0.0, -np.cos(tilt)])
    return replace(STANDING, gravity=gravity, angular_velocity=rate * axis)


@pytest.mark.parametrize("bearing", [0.0, 1.0, np.pi, -2.0])
def test_tipping_is_the_tilt_that_is_coming(bearing: float) -> None:
    assert tipping(leaning(0.3, 0.0, bearing)) == pytest.approx(0.3)
    assert tipping(leaning(0.3, 2.0, bearing)) == pytest.approx(0.3 + 2.0 * AHEAD)
    assert tipping(leaning(0.3, -2.0, bearing)) == pytest.approx(0.3 - 2.0 * AHEAD), "it comes back"
    spin = replace(leaning(0.3, 0.0, bearing), angular_velocity=5.0 * leaning(0.3, 0.0, bearing).gravity)
    assert tipping(spin) == pytest.approx(0.3), "turning about the vertical tilts nothing"
    assert tipping(leaning(0.0, 2.0, bearing)) == pytest.approx(2.0 * AHEAD)


def test_it_falls_when_that_is_certain_and_not_for_one_odd_sample() -> None:
    falling, lost = Falling(Legs(ROBOT), ROBOT.rate), leaning(0.5, 1.1 * (LOST - 0.5) / AHEAD)
    assert falling.watch(lost, 1) is None
    assert falling.watch(leaning(0.5, 0.0), 1) is None
    assert falling.watch(lost, 1) is None
    assert "tipping over" in (falling.watch(lost, 1) or "")
    falling.reset()
    assert falling.watch(lost, 1) is None


def test_upright_on_neither_sole_it_lies_and_on_one_it_kicks() -> None:
    falling = Falling(Legs(ROBOT), ROBOT.rate)
    pose = ROBOT.home.copy()
    pose[ROBOT.names.index("l_hip_pitch")] = -1.5  # a leg straight ahead
    pose[ROBOT.names.index("l_knee")] = 0.0
    kick, sits = pose.copy(), pose.copy()
    sits[ROBOT.names.index("r_hip_pitch")] = 1.5
    sits[ROBOT.names.index("r_knee")] = 0.0
    assert all(falling.watch(replace(STANDING, position=kick), 1) is None for _ in range(100))
    told = [falling.watch(replace(STANDING, position=sits), 1) for _ in range(60)]
    assert told[40] is None
    assert "neither sole" in (told[-1] or "")

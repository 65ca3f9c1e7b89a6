"""The script that carries goes by what it finds, whoever led the robot there: what learns from it sees no clock."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from task_bodies import state

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction
from servoid.hw.robot.description import load_robot
from servoid.stack.control.carrier import APPROACHES, CARRIES, PICKS, Carrier

ROBOT = load_robot()
AT_HAND = Instruction(
    np.zeros(3), goal=np.array([0.9, 0.2]), box=np.array([0.165, 0.0, 0.05, 1.0, 0.0, 0.0, 0.0])
)  # fmt: skip
HELD = replace(AT_HAND, box=np.array([0.165, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0]))
SEEN = replace(state(), position=ROBOT.home)
KNEES, ELBOW = [ROBOT.names.index(name) for name in ("l_knee", "r_knee")], ROBOT.names.index("l_el")


@pytest.fixture
def carrier() -> Carrier:
    carrier = Carrier(ROBOT)
    carrier.reset(None, np.zeros(()))
    return carrier


def squatting() -> Array:
    """Joint targets of a robot on its way down, with its arms open."""
    pose = ROBOT.home.copy()
    for name, value in {"knee": 2.0, "sho_pitch": -1.0, "sho_roll": 1.3, "el": 0.0}.items():
        left, right = (ROBOT.names.index(f"{side}_{name}") for side in "lr")
        pose[left], pose[right] = value, ROBOT.mirror[1][left] * value
    return pose


def test_who_does_not_follow_is_told_the_same_again(carrier: Carrier) -> None:
    told = [carrier.act(SEEN, squatting(), AT_HAND) for _ in range(60)]
    assert carrier.stage == PICKS  # it was led there by another: no walk bends both knees so
    assert np.array_equal(told[0], told[-1])
    assert 1.9 < told[0][KNEES[0]] < 2.2


def test_who_follows_comes_down_and_takes_the_box_and_rises(carrier: Carrier) -> None:
    applied, knees, elbows = squatting(), [], []
    for _ in range(160):
        applied = carrier.act(SEEN, applied, AT_HAND)
        knees.append(applied[KNEES[0]])
        elbows.append(applied[ELBOW])
        if knees[-1] > 2.3:
            break
    while carrier.stage == PICKS and len(knees) < 300:
        applied = carrier.act(SEEN, applied, HELD)
        knees.append(applied[KNEES[0]])
        elbows.append(applied[ELBOW])
    assert carrier.stage == CARRIES
    assert len(knees) < 170  # 3.4 s
    lowest = int(np.argmax(knees))
    assert elbows[lowest] > -0.05  # arms are open until it is down,
    assert elbows[-2] == pytest.approx(-0.37, abs=0.01)  # and closed as it rises
    assert knees[-2] < 1.2


def test_a_box_that_is_given_to_it_is_carried_and_one_that_was_lost_is_taken_anew(carrier: Carrier) -> None:
    carrier.act(SEEN, ROBOT.home, HELD)
    assert carrier.stage == CARRIES
    carrier.act(SEEN, ROBOT.home, AT_HAND)
    assert carrier.stage == APPROACHES


def test_who_rests_and_should_walk_is_told_by_no_clock(carrier: Carrier) -> None:
    """What a gait does at its first step depends on when it began, of which a pupil could learn but the mean."""
    far = replace(AT_HAND, box=np.array([0.5, 0.0, 0.05, 1.0, 0.0, 0.0, 0.0]))
    told = np.array([carrier.act(SEEN, ROBOT.home, far) for _ in range(60)])[:, ROBOT.leg_index.ravel()]
    assert np.ptp(told[:5], axis=0).max() > 0.05  # as long as it is not known to rest,
    assert np.ptp(told[40:], axis=0).max() < 0.01  # and from then on

"""A curriculum of speeds: it grows as what is asked is followed, up to what the gait can be asked for."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servoid.hw.robot.description import load_robot
from servoid.policy.references.gait import Gait, load_gait
from servoid.tools.learn.envs.motions import _draw
from servoid.tools.learn.envs.speeds import Speeds
from servoid.tools.learn.settings import TrackingSettings

ROBOT = load_robot()
GAIT = Gait(ROBOT, (4,), load_gait("gait-fast"))
AHEAD = np.array([[1.0, 0.0, 0.0]] * 4)


def walked(share: float, fallen: bool = False, ticks: int = 3000) -> Speeds:
    speeds = Speeds(ROBOT, GAIT)
    for _ in range(ticks):
        asked = AHEAD * speeds.walking.forward
        speeds.learn(asked, share * asked, np.array([fallen, False, False, False]))
    return speeds


def test_who_follows_is_asked_for_more_up_to_the_gaits_own() -> None:
    speeds = walked(0.9)
    assert speeds.walking.forward == pytest.approx(load_gait("gait-fast").max_velocity[0])
    assert speeds.walking.turning == ROBOT.walking.turning, "nobody was asked to turn"
    assert speeds.measures["followed/forward"] == pytest.approx(0.9)


def test_who_lags_or_falls_is_not() -> None:
    assert walked(0.7).walking.forward == ROBOT.walking.forward
    assert walked(0.9, fallen=True).walking.forward == ROBOT.walking.forward


def test_without_a_faster_gait_nothing_grows() -> None:
    speeds = Speeds(ROBOT)
    speeds.learn(AHEAD * 0.5, AHEAD * 0.5, np.zeros(4, bool))
    assert speeds.walking == ROBOT.walking
    assert speeds.measures == {}


def test_only_straight_walks_and_turns_on_the_spot_are_asked_for_more() -> None:
    top = replace(ROBOT.walking, forward=0.7, turning=3.0)
    settings = TrackingSettings(stand=0.0, forward=0.3, single=0.2, backward=0.2, turning=0.3)
    drawn = np.array([_draw(np.random.default_rng(i), settings, ROBOT.walking, top) for i in range(400)])
    ahead, around = drawn[:, 0] > ROBOT.walking.forward, np.abs(drawn[:, 2]) > ROBOT.walking.turning
    assert ahead.sum() > 20
    assert around.sum() > 20
    assert (np.abs(drawn[ahead][:, 1:]).max(), np.abs(drawn[around][:, :2]).max()) == (0.0, 0.0)

"""What leads a policy that gets up: clips at its pace, from either side, anew where the robot does not follow."""

from __future__ import annotations

import numpy as np
import pytest

from servoid.hw.robot.description import load_robot
from servoid.policy.motion.library import Library
from servoid.policy.rising.lead import CLIPS, PACE, Rising

ROBOT = load_robot()
LIBRARY = Library(ROBOT)
PAIR = [LIBRARY[name] for name in CLIPS]
FRONT, BACK, UPRIGHT = np.array([1.0, 0.0, 0.0]), np.array([-1.0, 0.0, 0.0]), np.array([0.0, 0.0, -1.0])


def follow(lead: Rising, ticks: int, gravity: np.ndarray, faster: float = 0.0) -> None:
    """Joints are where they are led to."""
    for _ in range(ticks):
        lead.advance(np.asarray(faster), gravity, lead.target, lead.target)


def test_gravity_says_which_clip_leads() -> None:
    lead = Rising(ROBOT, PAIR, (2,))
    lead.begin(np.ones(2, bool), np.stack([FRONT, BACK]))
    assert lead.side.tolist() == [0, 1]
    assert np.allclose(lead.target, [clip.joints[0] for clip in PAIR])
    lead.begin(np.array([False, True]), np.stack([FRONT, BACK]), np.array([1, 0]), np.array([5.0, 7.0]))
    assert lead.side.tolist() == [0, 0]  # only where it is to begin, and in the clip that is known
    assert lead.time.tolist() == [0.0, 7.0]


def test_an_action_sets_the_pace() -> None:
    times = []
    for faster in (-10.0, 0.0, 1.0, 10.0):
        lead = Rising(ROBOT, PAIR)
        lead.begin(np.ones((), bool), FRONT)
        follow(lead, 10, FRONT, faster)
        times.append(float(lead.time))
    assert times == sorted(times)
    assert times[0] == pytest.approx(3.0)  # it never stands still, and never leaps
    assert times[-1] == pytest.approx(30.0)


def test_it_waits_for_joints_that_are_on_their_way() -> None:
    lead = Rising(ROBOT, PAIR)
    lead.begin(np.ones((), bool), FRONT)
    late = lead.target.copy()
    late[3] += PACE.waits + 0.1
    lead.advance(np.zeros(()), FRONT, lead.target, late)
    assert float(lead.time) == 0.0
    beyond = ROBOT.upper + 5.0  # what is asked out of range is never reached, and not waited for
    lead.advance(np.zeros(()), FRONT, beyond, ROBOT.upper - ROBOT.limits.margin)
    assert float(lead.time) > 0.0


def test_it_ends_at_home_and_stays_there_while_the_robot_stands() -> None:
    lead = Rising(ROBOT, PAIR)
    lead.begin(np.ones((), bool), BACK, time=float(PAIR[1].ticks - 1))
    assert int(lead.side) == 1
    follow(lead, 200, UPRIGHT)
    assert np.allclose(lead.target, ROBOT.home)
    assert lead.seen[-1] == 1.0


def test_a_robot_that_falls_again_is_led_anew_from_where_it_lies() -> None:
    lead = Rising(ROBOT, PAIR)
    lead.begin(np.ones((), bool), FRONT, time=float(PAIR[0].ticks - 1))
    follow(lead, 10, BACK)
    assert float(lead.time) > 50  # a stumble
    follow(lead, 10, BACK)
    assert int(lead.side) == 1
    assert float(lead.time) < 20

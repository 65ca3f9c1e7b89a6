"""Limits as pure functions: one robot and many worlds alike."""

from __future__ import annotations

import numpy as np
from hypothesis import given, settings
from hypothesis import strategies as st

from servoid.hw.robot.description import load_robot
from servoid.stack.safety.limits import clamp, limit

ROBOT = load_robot("op3")
N = len(ROBOT.names)
poses = st.lists(st.floats(-4, 4), min_size=N, max_size=N).map(np.array)


@settings(max_examples=100, deadline=None)
@given(poses, poses, st.integers(1, 5))
def test_a_step_stays_within_the_rate_and_heads_for_the_range(target, previous, ticks):
    result = limit(target, previous, ROBOT, ticks)
    step = ROBOT.limits.joint_speed * ROBOT.dt * ticks
    assert np.abs(result - previous).max() <= step + 1e-9
    wanted = clamp(target, ROBOT)
    reachable = np.abs(wanted - previous) <= step
    np.testing.assert_allclose(result[reachable], wanted[reachable], atol=1e-12)
    assert (np.abs(result - wanted) <= np.abs(previous - wanted) + 1e-12).all()


def test_many_worlds_are_limited_like_one():
    rng = np.random.default_rng(0)
    target, previous = rng.uniform(-3, 3, (2, 7, N))
    one_by_one = np.stack([limit(t, p, ROBOT, 2) for t, p in zip(target, previous, strict=True)])
    np.testing.assert_array_equal(limit(target, previous, ROBOT, 2), one_by_one)


def test_clamp_keeps_the_margin():
    assert (clamp(np.full(N, 9.0), ROBOT) == ROBOT.upper - ROBOT.limits.margin).all()
    assert (clamp(np.full(N, -9.0), ROBOT) == ROBOT.lower + ROBOT.limits.margin).all()

"""What survival is measured on."""

from __future__ import annotations

import numpy as np
import pytest

from servoid.hw.robot.description import load_robot
from servoid.stack.control.fleet import Fleet
from servoid.stack.control.gait import GaitPolicy
from servoid.tools.learn import survival

ROBOT = load_robot()


def test_robots_that_survival_is_measured_on_are_none_of_the_training_data(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(survival, "_RANDOMISED", 1.0)
    measured = [survival.measured_fleet(ROBOT, 4, 0) for _ in range(2)]
    for fleet in measured:
        survival.survival_of(GaitPolicy(ROBOT, (4,)), fleet, seconds=0.02)
    collected = Fleet(ROBOT, 4, None, randomise=1.0, seed=0, threads=1)
    collected.reset(np.ones(4, bool))
    bias, again, other = (np.stack([b.gyro_bias for b in f.worlds.bodies]) for f in (*measured, collected))  # type: ignore[union-attr]
    np.testing.assert_array_equal(bias, again)
    assert not np.isin(bias, other).any()


def test_without_a_tag_an_episode_draws_by_seed_world_and_number() -> None:
    """Or a dataset of the same seed would not come out the same any more."""
    fleet = Fleet(ROBOT, 3, None, seed=7, threads=1)
    for _ in range(2):
        fleet.reset(np.arange(3) == 2)
    expected = np.random.default_rng([7, 2, 1])
    fleet.worlds.reset(np.array([2]), [expected])
    expected.normal(0.0, 1.0, 3)  # the bias that is left
    assert fleet.rngs[2].random() == expected.random()

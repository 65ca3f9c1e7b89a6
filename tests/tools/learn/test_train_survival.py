"""What survival is measured on."""

from __future__ import annotations

import numpy as np
import pytest

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import load_robot
from servoid.stack.control.fleet import Fleet
from servoid.tools.learn import survival

ROBOT = load_robot()


class Still:
    """Stands."""

    def reset(self, where: Array) -> None:
        pass

    def act(self, command: Array) -> Array:
        return np.tile(ROBOT.home, (len(command), 1))


def test_robots_that_survival_is_measured_on_are_none_of_the_training_data(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setattr(survival, "_RANDOMISED", 1.0)
    measured: list[Fleet] = []

    def drive(fleet: Fleet) -> Still:
        measured.append(fleet)
        return Still()

    for _ in range(2):
        survival.survival_of(drive, ROBOT, seconds=0.02, worlds=4, seed=0)
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
    fleet.worlds.reset(np.array([2]), [expected], ROBOT.home[None])
    expected.normal(0.0, 1.0, 3)  # the bias that is left
    assert fleet.rngs[2].random() == expected.random()

"""A table of reward terms: pure functions, and terms that remember."""

from __future__ import annotations

import numpy as np
import pytest

from servoid.hw.contracts.body import Array
from servoid.policy.mlp import Mlp
from servoid.tools.learn.terms import StatefulTerm, Terms


class MeanSpeed(StatefulTerm[Array]):
    """The mean of an episode so far."""

    def __init__(self, n: int) -> None:
        self._sum, self._ticks = np.zeros(n), np.zeros(n)

    def reset(self, where: Array) -> None:
        self._sum[where] = self._ticks[where] = 0.0

    def __call__(self, step: Array) -> Array:
        self._sum, self._ticks = self._sum + step, self._ticks + 1
        return self._sum / self._ticks


class Surprise(StatefulTerm[Array]):
    """How far a frozen network's guess from the tick before is off."""

    def __init__(self, network: Mlp, n: int) -> None:
        self._network, self._guess = network, np.full(n, np.nan)

    def reset(self, where: Array) -> None:
        self._guess[where] = np.nan

    def __call__(self, step: Array) -> Array:
        off = np.nan_to_num((step - self._guess) ** 2)
        self._guess = self._network(step[:, None])[:, 0]
        return off


def speed(step: Array) -> Array:
    return step


def test_terms_are_weighted_summed_and_logged() -> None:
    terms = Terms({"speed": 2.0}, {"speed": speed, "other": np.zeros_like})
    total, parts = terms(np.array([1.0, 3.0]))
    np.testing.assert_array_equal(total, [2.0, 6.0])
    assert parts == {"speed": 4.0}
    assert terms.names == ("speed",)


def test_a_term_remembers_its_episode_and_forgets_it_where_it_is_reset() -> None:
    double = Mlp([(np.full((1, 1), 2.0, np.float32), np.zeros(1, np.float32))], np.zeros(1), np.ones(1))
    terms = Terms(
        {"speed": 1.0, "mean": 10.0, "surprise": 100.0},
        {"speed": speed},
        {"mean": MeanSpeed(2), "surprise": Surprise(double, 2), "unused": MeanSpeed(2)},
    )
    terms.reset(np.ones(2, bool))
    np.testing.assert_allclose(terms(np.array([1.0, 2.0]))[0], [11.0, 22.0])
    np.testing.assert_allclose(terms(np.array([3.0, 4.0]))[0], [3 + 20 + 100, 4 + 30])  # 2 and 4 were guessed
    terms.reset(np.array([True, False]))
    np.testing.assert_allclose(terms(np.array([5.0, 8.0]))[0], [55.0, 8 + 10 * 14 / 3])


def test_a_weight_of_no_term_is_refused_with_the_nearest() -> None:
    with pytest.raises(ValueError, match="no reward term is called 'sped'; did you mean 'speed'"):
        Terms({"sped": 1.0}, {"speed": speed})

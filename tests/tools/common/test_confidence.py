"""Intervals hold what they say."""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import pytest

from servoid.tools.common.confidence import bootstrap, wilson


@pytest.mark.parametrize(
    ("successes", "n", "low", "high"),
    # R: binom.confint(x, n, methods = "wilson")
    [(0, 10, 0.0, 0.2775), (10, 10, 0.7225, 1.0), (5, 10, 0.2366, 0.7634), (190, 200, 0.9104, 0.9726)],
)
def test_wilson_interval(successes: int, n: int, low: float, high: float) -> None:
    assert wilson(successes, n) == pytest.approx([low, high], abs=5e-4)


def test_bootstrap_covers_the_mean_and_is_the_same_each_time() -> None:
    values = [float(x) for x in range(100)]
    low, high = bootstrap(values) or (0.0, 0.0)
    assert low == pytest.approx(49.5 - 1.98 * 29.0 / 10, abs=0.3)  # Student's interval, which this many values follow
    assert high == pytest.approx(49.5 + 1.98 * 29.0 / 10, abs=0.3)
    assert bootstrap(values) == [low, high]


@pytest.mark.parametrize(
    ("draw", "mean"),
    [
        (lambda rng: rng.normal(size=8), 0.0),
        (lambda rng: np.minimum(rng.exponential(2.0, size=8), 1.0), 2.0 * (1.0 - np.exp(-0.5))),  # lengths, and a limit
    ],
)
def test_bootstrap_of_few_values_covers_the_mean_as_often_as_it_says(
    draw: Callable[[np.random.Generator], np.ndarray], mean: float
) -> None:
    """Plain percentiles are far too near each other: of 6 values they cover the mean in 85 % of the cases."""
    rng = np.random.default_rng(1)
    intervals = [bootstrap(draw(rng)) for _ in range(300)]
    assert np.mean([interval is not None and interval[0] <= mean <= interval[1] for interval in intervals]) >= 0.90


def test_bootstrap_claims_nothing_of_too_few_values_or_equal_ones() -> None:
    assert bootstrap([1.0, 2.0, 3.0]) is None
    assert bootstrap([3000.0] * 100) is None
    assert bootstrap([1.0, 2.0, 3.0, 4.0]) == pytest.approx([1.0, 4.0], abs=0.3)

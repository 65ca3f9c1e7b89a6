"""95 % confidence intervals of what was measured over episodes."""

from __future__ import annotations

import math
from collections.abc import Sequence
from statistics import NormalDist

LEAST = 4  # values that a mean has an interval from
_RESAMPLES = 10_000
_Z = 1.959964  # the 97.5 % quantile of the normal distribution


def wilson(successes: int, n: int) -> list[float]:
    """95 % confidence interval of a share (E. B. Wilson, 1927)."""
    z, p = _Z, successes / n
    centre, spread = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return [max((centre - spread) / (1 + z * z / n), 0.0), min((centre + spread) / (1 + z * z / n), 1.0)]


def bootstrap(values: Sequence[float], median: bool = False) -> list[float] | None:
    """95 % confidence interval of a mean, or of a `median`: percentiles of those of resampled values, the same at every
    call.

    Resampling asks for no bell curve: episode lengths pile up at their limit. Percentiles lie further out than 2.5 %
    where values are few: "expanded" so that for normal values the interval is Student's (T. Hesterberg, "What teachers
    should know about the bootstrap", 2015, section 3.3). None for less than `LEAST` values, or where all are equal:
    those say nothing of how far others would lie.
    """
    import numpy as np

    n, sample = len(values), np.asarray(values, dtype=float)
    if n < LEAST or np.ptp(sample) == 0.0:
        return None
    resampled = sample[np.random.default_rng(0).integers(n, size=(_RESAMPLES, n))]
    means = np.median(resampled, axis=1) if median else resampled.mean(axis=1)
    tail = NormalDist().cdf(-math.sqrt(n / (n - 1)) * _student(n - 1))
    low, high = np.percentile(means, [100.0 * tail, 100.0 * (1.0 - tail)])
    return [float(low), float(high)]


def _student(freedom: int) -> float:
    """The 97.5 % quantile of Student's t, by the expansion of Abramowitz and Stegun, 26.7.5: to 0.2 % from 3 on."""
    z = _Z
    terms = (
        (z**3 + z) / 4,
        (5 * z**5 + 16 * z**3 + 3 * z) / 96,
        (3 * z**7 + 19 * z**5 + 17 * z**3 - 15 * z) / 384,
        (79 * z**9 + 776 * z**7 + 1482 * z**5 - 1920 * z**3 - 945 * z) / 92160,
    )
    return z + sum(term / freedom**power for power, term in enumerate(terms, 1))

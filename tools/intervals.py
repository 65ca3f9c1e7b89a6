"""95 % confidence intervals of what was measured over episodes."""

from __future__ import annotations

import math
from collections.abc import Sequence

_RESAMPLES = 10_000


def wilson(successes: int, n: int) -> list[float]:
    """95 % confidence interval of a share (E. B. Wilson, 1927)."""
    z, p = 1.959964, successes / n
    centre, spread = p + z * z / (2 * n), z * math.sqrt(p * (1 - p) / n + z * z / (4 * n * n))
    return [max((centre - spread) / (1 + z * z / n), 0.0), min((centre + spread) / (1 + z * z / n), 1.0)]


def bootstrap(values: Sequence[float]) -> list[float] | None:
    """95 % confidence interval of a mean: percentiles of the means of resampled values, the same at every call.

    Resampling asks for no bell curve: episode lengths pile up at their limit. None for less than two values.
    """
    import numpy as np

    if len(values) < 2:
        return None
    rng, sample = np.random.default_rng(0), np.asarray(values, dtype=float)
    means = [sample[rng.integers(len(sample), size=len(sample))].mean() for _ in range(_RESAMPLES)]
    low, high = np.percentile(means, [2.5, 97.5])
    return [float(low), float(high)]

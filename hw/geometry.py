"""Small vector algebra over any leading dimensions; for arrays of a few numbers, quicker than numpy's own."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array


def split(vectors: Array) -> tuple[Array, ...]:
    """Components of `(..., k)`: k arrays `(...)`."""
    return tuple(vectors[..., i] for i in range(vectors.shape[-1]))


def cross(a: Array, b: Array) -> Array:
    """Cross product of `(..., 3)` and `(..., 3)`, broadcast."""
    a0, a1, a2 = a[..., 0], a[..., 1], a[..., 2]
    b0, b1, b2 = b[..., 0], b[..., 1], b[..., 2]
    x = a1 * b2 - a2 * b1
    out = np.empty((*np.shape(x), 3))
    out[..., 0] = x
    out[..., 1] = a2 * b0 - a0 * b2
    out[..., 2] = a0 * b1 - a1 * b0
    return out


def joined(*components: Array) -> Array:
    """Components `(...)` side by side: `(..., k)`."""
    out = np.empty((*np.shape(components[0]), len(components)))
    for i, component in enumerate(components):
        out[..., i] = component
    return out

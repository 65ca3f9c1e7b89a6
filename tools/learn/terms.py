"""Rewards as a table of terms with weights. A term is a pure function of a step, or remembers: see `StatefulTerm`."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable, Mapping
from typing import Generic, TypeVar

import numpy as np

from servoid.hw.config import nearest
from servoid.hw.contracts.body import Array

Step = TypeVar("Step")


class StatefulTerm(ABC, Generic[Step]):
    """A term of `n` worlds with a memory: a running mean, say, or a frozen network over the last frames."""

    @abstractmethod
    def reset(self, where: Array) -> None:
        """Forget the worlds `where` `(n,)` bool: new episodes begin there."""

    @abstractmethod
    def __call__(self, step: Step) -> Array:
        """The term of one tick, `(n,)`. Called once a tick, before the worlds that are done are reset."""


class Terms(Generic[Step]):
    """A weighted sum of terms."""

    def __init__(
        self,
        weights: Mapping[str, float],
        pure: Mapping[str, Callable[[Step], Array]],
        stateful: Mapping[str, StatefulTerm[Step]] | None = None,
    ) -> None:
        """`pure` and `stateful` terms by name; those without a weight are left out.

        Raises ValueError for a weight of no term.
        """
        stateful = stateful or {}
        for name in weights:
            if name not in pure and name not in stateful:
                raise ValueError(f"no reward term is called '{name}'; {nearest(name, {**pure, **stateful})}")
        self._weights = dict(weights)
        self._terms: dict[str, Callable[[Step], Array]] = {**pure, **stateful}
        self._stateful = [term for name, term in stateful.items() if name in weights]

    @property
    def names(self) -> tuple[str, ...]:
        """Of the terms that count, in the order of their weights."""
        return tuple(self._weights)

    def reset(self, where: Array) -> None:
        """New episodes in the worlds `where` `(n,)` bool."""
        for term in self._stateful:
            term.reset(where)

    def __call__(self, step: Step, where: Array | None = None) -> tuple[Array, dict[str, float]]:
        """The sum `(n,)`, and the mean of each weighted term over the worlds `where` `(n,)` bool (default: all)."""
        parts = {name: weight * self._terms[name](step) for name, weight in self._weights.items()}
        count = None if where is None else max(int(where.sum()), 1)
        means = {
            name: float(part.mean() if count is None else part[where].sum() / count) for name, part in parts.items()
        }
        return np.sum(list(parts.values()), axis=0), means

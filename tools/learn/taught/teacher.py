"""Who teaches a task policy: drives some of the worlds itself, and says of all of them what it would do there."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, Policy, State


class Teacher:
    """A policy of `n` worlds, which acts once a tick; whom it teaches decides once in a few."""

    def __init__(self, policy: Policy, n: int) -> None:
        self._policy = policy
        self.leads = np.ones(n, bool)  # worlds that it drives
        self._told: list[Array] = []  # targets of the ticks since `taught`

    def reset(self, where: Array, seeds: Array) -> None:
        """New episodes in the worlds `where` `(n,)` bool."""
        self._policy.reset(where, seeds)

    def __call__(self, state: State, applied: Array, told: Instruction, target: Array) -> Array:
        """Joint targets of a tick `(n, n_joints)` rad: its own where it leads, `target` elsewhere."""
        decided = self._policy.act(state, applied, told)
        self._told.append(decided)
        return np.where(self.leads[:, None], decided, target)

    def taught(self) -> Array:
        """The mean of what it would have done since it was last asked `(n, n_joints)` rad: a decision that lasts as
        long does no better."""
        mean = np.mean(self._told, 0)
        self._told.clear()
        return np.asarray(mean)

"""A fleet driven by a diffusion model: all its robots are planned for as one batch, as the planner does for one."""

from __future__ import annotations

from typing import TYPE_CHECKING

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction
from servoid.policy.diffusion.features import raw_layout, raw_row
from servoid.stack.control.fleet import Fleet
from servoid.stack.control.trim import Trim

if TYPE_CHECKING:
    from servoid.policy.diffusion.runtime import Runtime


class PlannedWalker:
    """Joint targets `(n, n_joints)` for a fleet under velocity commands, like `servoid.tools.learn.envs.walker.Walker`.

    Plans are requested for all robots at the same ticks. A robot that is reset in between holds its pose until the next
    plan, and stood still in the past that this plan sees.
    """

    def __init__(self, fleet: Fleet, runtime: Runtime, seed: int = 0) -> None:
        self.fleet, self._runtime, self._seed = fleet, runtime, seed
        self._history, self._horizon = runtime.model.config.history, runtime.actions
        self._tick = 0
        size = raw_layout(len(fleet.robot.joints)).size
        self._space, width = runtime.model.space, runtime.model.config.action_size
        self._states = np.zeros((fleet.n, self._history, size), np.float32)  # newest last
        self._applied = np.zeros((fleet.n, self._history - 1, width))  # actions of all states but the newest
        self._plan, self._made = np.zeros((fleet.n, self._horizon, width)), 0
        self._predicted: Array | None = None  # (n, horizon, raw size) by the plans that run; None before the first
        self._waiting: tuple[Array, Array] | None = None  # the plans that are not adopted yet
        self._requested = 0
        self._trim = Trim(fleet.robot.dt, runtime.settings.trim, (fleet.n,))
        self._fresh = np.ones(fleet.n, bool)

    def reset(self, where: Array) -> None:
        """New episodes in the worlds `where`."""
        self._trim.reset(where)
        self._fresh = self._fresh | where

    def act(self, command: Array) -> Array:
        """Targets for the present state of the fleet under `command` `(n, 3)`."""
        from servoid.policy.diffusion.rolling import Previous

        settings, tick = self._runtime.settings, self._tick
        self._observe()
        asked = self._trim(self.fleet.state, command)
        if self._waiting is not None and tick == self._requested + settings.delay:
            (self._plan, self._predicted), self._made, self._waiting = self._waiting, self._requested, None
        if tick % settings.replan == 0:
            ahead = np.stack([self._action(tick + i) for i in range(settings.delay)], 1) if settings.delay else None
            actions = self._applied if ahead is None else np.concatenate([self._applied, ahead], 1)
            seeds = [(self._seed + i, tick) for i in range(self.fleet.n)]
            previous = None
            if self._predicted is not None:
                previous = Previous(tick - self._made, self._predicted, self._plan)
            window = self._states, actions, Instruction(asked)
            plan, predicted = self._runtime.plan_batch(*window, seeds, previous)
            self._requested = tick
            if settings.delay:
                self._waiting = plan, predicted
            else:
                self._plan, self._predicted, self._made = plan, predicted, tick
        self._tick += 1
        return self._space.decode(self._states[:, -1], self._action(tick))

    def _observe(self) -> None:
        """Take in the state, and what was applied at the tick before."""
        row, target = raw_row(self.fleet.state), self.fleet.applied
        fresh = self._fresh
        decided = np.where(fresh[:, None], row, self._states[:, -1])  # the state that the target was decided on
        applied = self._space.encode(decided, target)
        self._states = np.concatenate([self._states[:, 1:], row[:, None]], 1)
        self._applied = np.concatenate([self._applied[:, 1:], applied[:, None]], 1)
        if fresh.any():
            self._states[fresh], self._applied[fresh] = row[fresh, None], applied[fresh, None]
            still = applied[fresh, None], row[fresh, None]
            self._plan = _with(self._plan, fresh, still[0])
            if self._predicted is not None:
                self._predicted = _with(self._predicted, fresh, still[1])
            if self._waiting is not None:
                self._waiting = _with(self._waiting[0], fresh, still[0]), _with(self._waiting[1], fresh, still[1])
            self._fresh = np.zeros_like(fresh)

    def _action(self, tick: int) -> Array:
        return self._plan[:, min(tick - self._made, self._horizon - 1)]


def _with(array: Array, where: Array, value: Array) -> Array:
    """A copy of `array` with rows `where` replaced."""
    out = array.copy()
    out[where] = value
    return out

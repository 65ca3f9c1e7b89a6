"""The plan that runs, and the one that is on its way: requests at a steady pace, adoption by tick, late plans.

A plan requested at tick k is adopted at tick k + delay and was made for the actions that run meanwhile. While a plan is
late, the last one goes on by its tick index, and no other is asked for. When it comes it is adopted all the same: it
knows more than the one that runs, though not what ran since it was due. So a machine that is too slow for `delay` walks
worse, as with a longer delay, and does not stop. A planner that finds no plan, because guidance diverged for one, says
why: the last plan goes on.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, replace

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Adopted, Instruction, Plan, PlanRequest
from servoid.policy.diffusion.model.action_space import ActionSpace
from servoid.stack.control.planning.planner import Planner

_MANY = 25  # late plans in a row after which it is said that the machine is too slow


@dataclass(frozen=True)
class Pace:
    """When plans are asked for and adopted, in ticks. Raises ValueError where that cannot be."""

    history: int  # states that a request holds: the first request waits for as many
    execution_horizon: int  # from a request to the next
    delay: int  # from a request to the adoption of its plan
    wait: bool = True  # for a plan that is due, so that none is ever late: for simulation

    def __post_init__(self) -> None:
        if not 0 <= self.delay <= self.execution_horizon:
            raise ValueError(f"delay must be 0 to execution_horizon ({self.execution_horizon} ticks), not {self.delay}")


class History:
    """The last states and what ran on them, of worlds of any leading `shape`.

    A world that begins stood still in the past that is made up for it.
    """

    def __init__(self, length: int, space: ActionSpace, shape: tuple[int, ...]) -> None:
        self._length, self._space = length, space
        self.fresh = np.ones(shape, bool)  # worlds that have not been seen since they began
        self.states: Array  # (..., length, raw size), newest last
        self.actions: Array  # (..., length - 1, action size) of all states but the newest
        self.ran: Array  # (..., action size), the newest of them
        self._empty = True

    def reset(self, where: Array) -> None:
        """Forget the past of the worlds `where`."""
        self.fresh = self.fresh | where

    def add(self, row: Array, target: Array) -> None:
        """Take in raw rows `(..., raw size)`, and joint targets `(..., n_joints)` that ran at the tick before.

        A target is encoded with the state that it was decided on.
        """
        before = row if self._empty else np.where(self.fresh[..., None], row, self.states[..., -1, :])
        self.ran = ran = self._space.encode(before, target)
        if self._empty or self.fresh.all():
            self.states = np.repeat(row[..., None, :], self._length, -2)
            self.actions = np.repeat(ran[..., None, :], self._length - 1, -2)
        else:
            fresh = self.fresh[..., None, None]
            states = np.concatenate([self.states[..., 1:, :], row[..., None, :]], -2)
            actions = np.concatenate([self.actions[..., 1:, :], ran[..., None, :]], -2)
            self.states = np.where(fresh, row[..., None, :], states)
            self.actions = np.where(fresh, ran[..., None, :], actions)
        self._empty, self.fresh = False, np.zeros_like(self.fresh)


class PlanBuffer:
    """Asks a planner for plans of one robot, or of many at once, and hands out the actions of the plan that runs.

    Ticks count from the last reset of all worlds together; `shape` are the leading dimensions of all arrays. Worlds
    that begin anew in between hold their pose until a plan comes that was asked for since.
    """

    def __init__(self, planner: Planner, pace: Pace, shape: tuple[int, ...] = ()) -> None:
        self.planner, self.pace = planner, pace
        self._begun = np.zeros(shape, int)  # ticks at which episodes began
        self._seeds: Array = np.zeros(shape, int)
        self._only: Mapping[int, int] | None = None  # where a recorded run is repeated: its requests, and when adopted
        self.reset()

    def reset(self) -> None:
        """Begin anew in all worlds: forget all plans."""
        self.planner.reset()
        self.tick = 0
        self.latest: Plan | None = None  # the plan that runs
        self.adopted: Adopted | None = None  # in this tick
        self.events: list[str] = []  # what a person should know of
        self._begun = np.zeros_like(self._begun)
        self._held: tuple[Array, Array] | None = None  # pose of worlds that began later: action and raw row
        self._requested: int | None = None  # what the planner is busy with
        self._coming: Plan | None = None  # of that request, where it came before it is to be adopted
        self._late = 0  # plans in a row
        self._ended = self._refused = False

    def seed(self, where: Array, seeds: Array) -> None:
        """Plans of the worlds `where` draw their noise from `seeds` and the age of the episode."""
        self._seeds = np.where(where, seeds, self._seeds)

    def repeat(self, plans: Mapping[int, int]) -> None:
        """Take over the plans of a recorded run and no others: ticks of their requests, and of their adoption."""
        self._only = plans

    def hold(self, where: Array, row: Array, action: Array) -> None:
        """Worlds `where` begin at this tick: in raw rows `(..., raw size)`, `(..., action size)` being their pose."""
        mask = where[..., None]
        self._begun = np.where(where, self.tick, self._begun)
        old_action, old_row = self._held or (action, row)
        self._held = np.where(mask, action, old_action), np.where(mask, row, old_row)
        if self.latest is not None:
            self.latest = self._holding(self.latest, where)

    def adopt(self) -> None:
        """Take over the plan that is due at this tick, or was due before. Raises PlannerError."""
        self.adopted = None
        self._take_over()

    @property
    def due(self) -> bool:
        """Whether a plan is to be asked for at this tick. A recorded run says so of a plan that it did adopt."""
        return self.tick % self.pace.execution_horizon == 0 and self.free

    @property
    def free(self) -> bool:
        """Whether the planner may be asked at this tick, due or not: it waits for the history, and for one answer."""
        idle = self._requested is None or (self._only is not None and self.tick in self._only)
        return self.tick >= self.pace.history - 1 and idle

    def ask(self, history: History, meanwhile: list[Array], instruction: Instruction) -> None:
        """Ask for a plan; `meanwhile` are the actions of the next `delay` ticks. Without delay it is adopted now."""
        actions = history.actions
        if meanwhile:
            actions = np.concatenate([actions, np.stack(meanwhile, -2)], -2)
        ages = self.tick - self._begun
        request = PlanRequest(self.tick, history.states, actions, instruction, self.latest, self._seeds, ages)
        self.planner.submit(request)
        self._requested, self._coming = self.tick, None
        self._take_over()

    @property
    def left(self) -> int:
        """For how many ticks from this one on the plan says what to do; 0: there is none, or it has ended."""
        plan = self.latest
        return 0 if plan is None else max(plan.tick + plan.actions.shape[-2] - self.tick, 0)

    def action(self, ahead: int = 0) -> Array:
        """The action `(..., action size)` so many ticks ahead by the running plan, of `left` ones."""
        assert self.latest is not None
        return np.array(self.latest.actions[..., self.tick + ahead - self.latest.tick, :])

    def end(self, then: str) -> None:
        """Say once of a plan that it has ended before another one came, and what is done `then`."""
        if self.latest is not None and not self._ended:
            self._ended = True
            self.events.append(f"the plan of tick {self.latest.tick} ended before another one came: {then}")

    def _take_over(self) -> None:
        tick = self.tick
        if self._requested is None or tick < self._requested + self.pace.delay:
            return
        requested, due = self._requested, self._requested + self.pace.delay
        self._coming = plan = self._coming or self.planner.collect(requested, self.pace.wait)
        if plan is None or (self._only is not None and self._only.get(requested) != tick and not plan.error):
            if tick == due and not self._late:  # of many in a row, the first
                self.events.append(f"the plan requested at tick {requested} was not ready at {tick}: {self._running()}")
            return
        self._requested = self._coming = None
        if plan.error:
            if not self._refused:  # one that comes again and again is said once
                self.events.append(f"no plan for tick {requested}: {plan.error}: {self._running()}")
            self._refused = True
            return
        if tick >= plan.tick + plan.actions.shape[-2]:
            return  # it says nothing of the ticks to come
        self._late = self._late + 1 if tick > due else 0
        if self._late == _MANY:
            self.events.append(
                f"{_MANY} plans in a row were late: this machine is busy, or too slow for delay: {self.pace.delay} and "
                f"execution_horizon: {self.pace.execution_horizon}: set them higher, or steps lower"
            )
        if (late := self._begun > requested).any():
            plan = self._holding(plan, late)
        self.latest, self._ended, self._refused = plan, False, False
        self.adopted = Adopted(requested, tick, plan)

    def _holding(self, plan: Plan, where: Array) -> Plan:
        """The plan with the worlds `where` holding their pose."""
        assert self._held is not None
        (action, row), mask = self._held, where[..., None, None]
        actions = np.where(mask, action[..., None, :], plan.actions)
        return replace(plan, actions=actions, states=np.where(mask, row[..., None, :], plan.states))

    def _running(self) -> str:
        return "the goal is held" if self.latest is None else f"that of {self.latest.tick} goes on"

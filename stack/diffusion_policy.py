"""The diffusion planner-controller as a policy: history in, requests out, plans executed by tick.

A plan requested at tick k is adopted at tick k + delay and was made for the actions that run meanwhile. A plan that is
late is not adopted: the last one goes on by its tick index. So a run does not depend on how fast the machine was. A
planner that finds no plan, because guidance diverged for one, says why: the last plan goes on, and then its last action
is held.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Container
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from hw.hal import Array, Instruction, Plan, PlanRequest, State
from hw.robot import Robot
from policy.checkpoint import read_header, resolve
from policy.diffusion.config import check_fit
from policy.diffusion.features import raw_row
from policy.diffusion.settings import DiffusionSettings, load_settings
from policy.text.captions import caption
from stack.planner import Answer, InlinePlanner, Planner, ProcessPlanner
from stack.trim import Trim

if TYPE_CHECKING:
    from policy.diffusion.runtime import Cost, Runtime


class DiffusionPolicy:
    """Asks a planner every `replan` ticks and runs its plans. One robot; ticks count calls of `act` since `reset`.

    `latest_plan` is the plan that runs; `adopted` lists (requested tick, adopted tick) of all plans of the episode.
    """

    def __init__(
        self, planner: Planner, history: int, replan: int, delay: int, wait: bool = True, trim: Trim | None = None
    ) -> None:
        """`history` is the number of states that a request holds. With `wait` no plan is ever late: for simulation.

        `trim` corrects the velocity that is asked of the planner.
        """
        if not 0 <= delay <= replan:
            raise ValueError(f"delay must be 0 to replan ({replan} ticks), not {delay}")
        self._planner = planner
        self._history, self._replan, self._delay, self._wait, self._trim = history, replan, delay, wait, trim
        self._states: deque[Array] = deque(maxlen=history)
        self._applied: deque[Array] = deque(maxlen=history - 1)
        self.only: Container[int] | None = None  # requests in time in a recorded run, where it is repeated
        self.reset(0)

    def reset(self, seed: int) -> None:
        """Begin an episode; its plans draw their noise from `seed`."""
        self._planner.reset(seed)
        if self._trim is not None:
            self._trim.reset()
        self._tick = 0
        self._states.clear()
        self._applied.clear()
        self._hold: Array | None = None
        self._requested: int | None = None
        self._ended = self._refused = False
        self._events: list[str] = []
        self.latest_plan: Plan | None = None
        self.adopted: list[tuple[int, int]] = []

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        """Joint targets `(n_joints,)` rad for this tick; the goal is held until the first plan.

        Raises PlannerError when the planner cannot plan any more.
        """
        if self._hold is None:
            self._hold = np.array(applied, dtype=float)
        self._states.append(raw_row(state))
        self._applied.append(np.array(applied, dtype=float))  # what ran at the tick before
        tick = self._tick
        if self._trim is not None:
            # What is asked has its name before it is corrected: a little drift must not turn a walk into an arc.
            asked = instruction.velocity
            text = caption(asked) if instruction.text is None else instruction.text
            instruction = replace(instruction, velocity=self._trim(state, asked), text=text)
        self._adopt(tick)
        if tick % self._replan == 0 and len(self._states) == self._history:
            meanwhile = [self._action(tick + i) for i in range(self._delay)]
            actions = np.stack([*self._applied, *meanwhile])
            states = np.stack(self._states)
            self._planner.submit(PlanRequest(tick, states, actions, instruction, self.latest_plan))
            self._requested = tick
            self._adopt(tick)  # at once, when there is no delay
        if self.latest_plan is not None and tick >= self._end and not self._ended:
            self._ended = True
            self._events.append(
                f"the plan of tick {self.latest_plan.tick} ended before another one came: its last action is held"
            )
        self._tick += 1
        return self._action(tick)

    def take_events(self) -> tuple[str, ...]:
        """What a person should know of, since the last call: late plans, and plans that came to their end."""
        events, self._events = tuple(self._events), []
        return events

    def close(self) -> None:
        """End the planner."""
        self._planner.close()

    @property
    def _end(self) -> int:
        """First tick after the running plan."""
        assert self.latest_plan is not None
        return self.latest_plan.tick + len(self.latest_plan.actions)

    def _adopt(self, tick: int) -> None:
        """Take over the plan that is due at `tick`."""
        if self._requested is None or tick < self._requested + self._delay:
            return
        requested, self._requested = self._requested, None
        plan = self._planner.collect(requested, self._wait)
        if plan is not None and plan.error:
            if not self._refused:  # one that comes again and again is said once
                self._events.append(f"no plan for tick {requested}: {plan.error}: {self._running()}")
            self._refused = True
            return
        if self.only is not None and requested not in self.only:
            plan = None
        if plan is None:
            self._events.append(f"the plan requested at tick {requested} was not ready at {tick}: {self._running()}")
            return
        self.latest_plan, self._ended, self._refused = plan, False, False
        self.adopted.append((requested, tick))

    def _running(self) -> str:
        return "the goal is held" if self.latest_plan is None else f"that of {self.latest_plan.tick} goes on"

    def _action(self, tick: int) -> Array:
        """What runs at `tick` by the running plan."""
        if self.latest_plan is None:
            assert self._hold is not None
            return self._hold.copy()
        actions = self.latest_plan.actions
        return np.array(actions[min(tick - self.latest_plan.tick, len(actions) - 1)])


def diffusion_policy(
    robot: Robot,
    settings: DiffusionSettings | None = None,
    cost: Cost | None = None,
    *,
    process: bool = False,
) -> DiffusionPolicy:
    """The diffusion policy for `robot`, by default as configs/policies/diffusion.yaml says.

    `cost` guides its plans, `Task.cost` for one; with `process`, which is for real time, it must be picklable and
    depend on nothing but its arguments. Raises ConfigError, also where checkpoint, settings and robot do not fit.
    """
    settings = settings or load_settings()
    path = resolve(settings.checkpoint)
    settings = replace(settings, checkpoint=str(path))
    planner: Planner
    if process:
        _check(robot, settings)
        planner = ProcessPlanner(partial(_build, robot, settings, cost))
    else:
        planner = InlinePlanner(_build(robot, settings, cost))
    history = int(read_header(path)["config"]["history"])
    trim = Trim(robot.dt, settings.trim) if settings.trim else None
    return DiffusionPolicy(planner, history, settings.replan, settings.delay, wait=not process, trim=trim)


def _check(robot: Robot, settings: DiffusionSettings) -> None:
    """Refuse here, with a plain error, what the planner process would refuse."""
    path = resolve(settings.checkpoint)
    config = check_fit(path, read_header(path), robot)
    settings.check(config)


def _build(robot: Robot, settings: DiffusionSettings, cost: Cost | None) -> Answer:
    from policy.diffusion.runtime import load_runtime

    runtime = load_runtime(robot, settings, cost)
    runtime.warm_up()
    return partial(_plan, runtime)


def _plan(runtime: Runtime, request: PlanRequest, seed: int) -> Plan:
    """The plan of a request, or why there is none."""
    from policy.diffusion.sampler import Diverged

    try:
        return runtime.plan(request, seed)
    except Diverged as error:
        nothing = np.full((1, 1), np.nan)
        return Plan(request.tick, nothing, nothing, nothing, 0.0, str(error))

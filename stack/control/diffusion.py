"""The diffusion planner-controller as a policy: history in, requests out, plans executed by tick.

A plan requested at tick k is adopted at tick k + delay and was made for the actions that run meanwhile. While a plan is
late, the last one goes on by its tick index, and no other is asked for. When it comes it is adopted all the same: it
knows more than the one that runs, though not what ran since it was due. So a machine that is too slow for `delay` walks
worse, as with a longer delay, and does not stop. A planner that finds no plan, because guidance diverged for one, says
why: the last plan goes on. Where a plan ends before another one comes, the robot goes to the pose that it stands in:
held in mid step it stays up, but falls when it is to walk on, or to be lowered.

What a plan's actions are is up to the model: joint targets, or latents. A latent is decoded here, at its own tick and
with the state of that tick. What is asked with a request is in the same terms: targets that ran are encoded with the
state that they were decided on, since the guard may have changed what was decoded; of those to come the plan has the
latents, and nobody knows the states yet.
"""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Adopted, Instruction, Plan, PlanRequest, State
from servoid.hw.robot.description import Robot
from servoid.policy.checkpoint import read_header, resolve
from servoid.policy.diffusion.features import raw_row
from servoid.policy.diffusion.model.action_space import JOINT_TARGETS, ActionSpace, load_action_space
from servoid.policy.diffusion.model.config import check_fit
from servoid.policy.diffusion.settings import DiffusionSettings, load_settings
from servoid.stack.control.base import BasePolicy
from servoid.stack.control.planner import Answer, InlinePlanner, Planner, ProcessPlanner
from servoid.stack.control.trim import Trim
from servoid.stack.safety.min_jerk import MinJerk

if TYPE_CHECKING:
    from servoid.policy.diffusion.runtime import Cost, Runtime

STAND_SECONDS = 0.4  # with 0.8 s some fell
_MANY = 25  # late plans in a row after which it is said that the machine is too slow


class DiffusionPolicy(BasePolicy):
    """Asks a planner every `replan` ticks and runs its plans. One robot; ticks count calls of `act` since `reset`.

    `latest_plan` is the plan that runs.
    """

    def __init__(
        self,
        planner: Planner,
        history: int,
        replan: int,
        delay: int,
        wait: bool = True,
        trim: Trim | None = None,
        space: ActionSpace = JOINT_TARGETS,
        stand: Callable[[Array], MinJerk] | None = None,
    ) -> None:
        """`history` is the number of states that a request holds. With `wait` no plan is ever late: for simulation.

        `trim` corrects the velocity that is asked of the planner. `space` is what its plans call actions. `stand` is
        the way from a pose to that of standing, for when a plan has ended; without it the last action is held.
        """
        if not 0 <= delay <= replan:
            raise ValueError(f"delay must be 0 to replan ({replan} ticks), not {delay}")
        self._planner = planner
        self._history, self._replan, self._delay, self._wait, self._trim = history, replan, delay, wait, trim
        self._space = space
        self._stand = stand
        self._states: deque[Array] = deque(maxlen=history)
        self._applied: deque[Array] = deque(maxlen=history - 1)
        self._only: Mapping[int, int] | None = None  # where a recorded run is repeated: its requests, and when adopted
        self.reset(0)

    @property
    def adopted(self) -> Adopted | None:
        """The plan that was taken over in the last call of `act`."""
        return self._adopted

    def repeat(self, plans: Mapping[int, int]) -> None:
        """Take over the plans of a recorded run and no others: ticks of their requests, and of their adoption."""
        self._only = plans

    def reset(self, seed: int) -> None:
        """Begin an episode; its plans draw their noise from `seed`."""
        self._planner.reset(seed)
        if self._trim is not None:
            self._trim.reset()
        self._tick = 0
        self._states.clear()
        self._applied.clear()
        self._target: Array | None = None  # the last one: what is held where no plan says more
        self._way: MinJerk | None = None  # to standing
        self._requested: int | None = None  # what the planner is busy with
        self._plan: Plan | None = None  # of that request, where it came before it is to be adopted
        self._late = 0  # plans in a row
        self._ended = self._refused = False
        self._events: list[str] = []
        self.latest_plan: Plan | None = None
        self._adopted: Adopted | None = None

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        """Joint targets `(n_joints,)` rad for this tick; the goal is held until the first plan.

        Raises PlannerError when the planner cannot plan any more.
        """
        applied = np.array(applied, dtype=float)
        if self._target is None:
            self._target = applied
        row = raw_row(state)
        before = self._states[-1] if self._states else row
        self._states.append(row)
        self._applied.append(self._space.encode(before, applied))  # what ran at the tick before
        tick, self._adopted = self._tick, None
        if self._trim is not None:
            instruction = replace(instruction, velocity=self._trim(state, instruction.velocity))
        self._adopt(tick)
        if tick % self._replan == 0 and len(self._states) == self._history and self._idle(tick):
            actions = np.stack([*self._applied, *self._meanwhile(tick, row)])
            states = np.stack(self._states)
            self._planner.submit(PlanRequest(tick, states, actions, instruction, self.latest_plan))
            self._requested, self._plan = tick, None
            self._adopt(tick)  # at once, when there is no delay
        if self.latest_plan is not None and self._over(tick) and not self._ended:
            self._ended = True
            self._events.append(
                f"the plan of tick {self.latest_plan.tick} ended before another one came: "
                + ("the robot comes to a stand" if self._stand else "its last action is held")
            )
        self._tick += 1
        if not self._over(tick):
            self._target, self._way = self._space.decode(row, self._action(tick)), None
        elif self.latest_plan is not None and self._stand is not None:
            self._way = self._way or self._stand(self._target)
            self._target = self._way.next()
        return self._target.copy()

    def take_events(self) -> tuple[str, ...]:
        """What a person should know of, since the last call: late plans, and plans that came to their end."""
        events, self._events = tuple(self._events), []
        return events

    def close(self) -> None:
        """End the planner."""
        self._planner.close()

    def _over(self, tick: int) -> bool:
        """Whether no plan says anything of `tick`: there is none, or it has ended."""
        plan = self.latest_plan
        return plan is None or tick >= plan.tick + len(plan.actions)

    def _idle(self, tick: int) -> bool:
        """Whether the planner may be asked. A recorded run says so of a plan that it did adopt."""
        return self._requested is None or (self._only is not None and tick in self._only)

    def _adopt(self, tick: int) -> None:
        """Take over the plan that is due at `tick`, or was due before."""
        if self._requested is None or tick < self._requested + self._delay:
            return
        requested, due = self._requested, self._requested + self._delay
        self._plan = plan = self._plan or self._planner.collect(requested, self._wait)
        if plan is None or (self._only is not None and self._only.get(requested) != tick and not plan.error):
            if tick == due and not self._late:  # of many in a row, the first
                self._events.append(
                    f"the plan requested at tick {requested} was not ready at {tick}: {self._running()}"
                )
            return
        self._requested = self._plan = None
        if plan.error:
            if not self._refused:  # one that comes again and again is said once
                self._events.append(f"no plan for tick {requested}: {plan.error}: {self._running()}")
            self._refused = True
            return
        if tick >= plan.tick + len(plan.actions):
            return  # it says nothing of the ticks to come
        self._late = self._late + 1 if tick > due else 0
        if self._late == _MANY:
            self._events.append(
                f"{_MANY} plans in a row were late: this machine is busy, or too slow for delay: {self._delay} and "
                f"replan: {self._replan}: set them higher, or steps lower"
            )
        self.latest_plan, self._ended, self._refused = plan, False, False
        self._adopted = Adopted(requested, tick, plan)

    def _meanwhile(self, tick: int, row: Array) -> list[Array]:
        """The actions of the next `delay` ticks, as long as no other plan comes."""
        plan = self.latest_plan
        says = 0 if plan is None else max(plan.tick + len(plan.actions) - tick, 0)
        actions = [self._action(tick + ahead) for ahead in range(min(says, self._delay))]
        if len(actions) < self._delay:
            last = self._space.decode(row, actions[-1]) if actions else self._target
            assert last is not None
            way = self._way or (MinJerk(last, last, 1) if plan is None or self._stand is None else self._stand(last))
            actions += [self._space.encode(row, way.ahead(1 + n)) for n in range(self._delay - len(actions))]
        return actions

    def _running(self) -> str:
        return "the goal is held" if self.latest_plan is None else f"that of {self.latest_plan.tick} goes on"

    def _action(self, tick: int) -> Array:
        """The action of `tick` by the running plan, or its last one."""
        assert self.latest_plan is not None
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
    head = read_header(path)
    config = check_fit(path, head, robot)
    settings.check(config, head.get("training"))  # here, with a plain error, rather than in the planner's process
    space = load_action_space(path, robot)
    planner: Planner
    if process and not settings.delay:
        raise ConfigError(
            "diffusion policy: delay 0 wants plans that take no time: in real time set delay to 1 or more"
        )
    if process:
        planner = ProcessPlanner(partial(_build, robot, settings, cost))
    else:
        planner = InlinePlanner(_build(robot, settings, cost))
    trim = Trim(robot.dt, settings.trim) if settings.trim else None
    pace = settings.replan, settings.delay

    def stand(pose: Array) -> MinJerk:
        return MinJerk(pose, robot.home, round(STAND_SECONDS * robot.rate))

    return DiffusionPolicy(planner, config.history, *pace, wait=not process, trim=trim, space=space, stand=stand)


def _build(robot: Robot, settings: DiffusionSettings, cost: Cost | None) -> Answer:
    from servoid.policy.diffusion.runtime import load_runtime

    runtime = load_runtime(robot, settings, cost)
    runtime.warm_up()
    return partial(_plan, runtime)


def _plan(runtime: Runtime, request: PlanRequest, seed: int) -> Plan:
    """The plan of a request, or why there is none."""
    from servoid.policy.diffusion.guidance import Diverged

    try:
        return runtime.plan(request, seed)
    except Diverged as error:
        nothing = np.full((1, 1), np.nan)
        return Plan(request.tick, nothing, nothing, nothing, 0.0, str(error))

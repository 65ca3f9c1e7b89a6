"""The diffusion planner-controller as a policy: history in, requests out, plans executed by tick.

When plans are asked for and adopted is in `plan_buffer`. Where a plan ends before another one comes, the robot goes to
the pose that it stands in: held in mid step it stays up, but falls when it is to walk on, or to be lowered.

What a plan's actions are is up to the model: joint targets, or latents. A latent is decoded here, at its own tick and
with the state of that tick. What is asked with a request is in the same terms: targets that ran are encoded with the
state that they were decided on, since the guard may have changed what was decoded; of those to come the plan has the
latents, and nobody knows the states yet.
"""

from __future__ import annotations

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
from servoid.policy.diffusion.model.action_space import JOINT_TARGETS, ActionSpace, load_action_space
from servoid.policy.diffusion.model.config import check_fit
from servoid.policy.diffusion.settings import DiffusionSettings, load_settings
from servoid.policy.features import raw_row
from servoid.stack.control.base import BasePolicy
from servoid.stack.control.planning.plan_buffer import History, Pace, PlanBuffer
from servoid.stack.control.planning.planner import Answer, InlinePlanner, Planner, ProcessPlanner
from servoid.stack.control.planning.trim import Trim
from servoid.stack.safety.min_jerk import MinJerk
from servoid.stack.tasks.terms.guidance import Stopping

if TYPE_CHECKING:
    from servoid.policy.diffusion.runtime import Cost, Runtime

STAND_SECONDS = 0.4  # with 0.8 s some fell


class DiffusionPolicy(BasePolicy):
    """Asks a planner for plans and runs them, for one robot or for worlds of any leading `shape`."""

    def __init__(
        self,
        planner: Planner,
        pace: Pace,
        *,
        trim: Trim | None = None,
        space: ActionSpace = JOINT_TARGETS,
        stand: Callable[[Array], MinJerk] | None = None,
        shape: tuple[int, ...] = (),
    ) -> None:
        """`trim` corrects the velocity that is asked of the planner. `space` is what its plans call actions. `stand` is
        the way from a pose to that of standing, for when a plan has ended; without it the last action is held.
        """
        self.plans = PlanBuffer(planner, pace, shape)
        self._trim, self._space, self._stand, self._shape = trim, space, stand, shape
        self._history = History(pace.history, space, shape)
        self._target: Array | None = None  # the last one: what is held where no plan says more
        self._way: MinJerk | None = None  # to standing

    @property
    def adopted(self) -> Adopted | None:
        """The plan that was taken over in the last call of `act`."""
        return self.plans.adopted

    def repeat(self, plans: Mapping[int, int]) -> None:
        """Take over the plans of a recorded run and no others: ticks of their requests, and of their adoption."""
        self.plans.repeat(plans)

    def reset(self, where: Array | None, seeds: Array) -> None:
        """Begin episodes in the worlds `where`, whose plans draw their noise from `seeds`."""
        where = np.ones(self._shape, bool) if where is None else where
        if self._trim is not None:
            self._trim.reset(where)
        self._history.reset(where)
        if where.all():
            self.plans.reset()
            self._target = self._way = None
        self.plans.seed(where, seeds)

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        """Joint targets `(..., n_joints)` rad for this tick; the goal is held until the first plan.

        Raises PlannerError when the planner cannot plan any more.
        """
        applied, plans = np.array(applied, dtype=float), self.plans
        row = raw_row(state)
        self._see(row, applied)
        if self._trim is not None:
            instruction = replace(instruction, velocity=self._trim(state, instruction.velocity))
        plans.adopt()
        if plans.due:
            plans.ask(self._history, self._meanwhile(row), instruction)
        if plans.left:
            self._target, self._way = self._space.decode(row, plans.action()), None
        else:
            plans.end("the robot comes to a stand" if self._stand else "its last action is held")
            if plans.latest is not None and self._stand is not None:
                self._way = self._way or self._stand(self._last)
                self._target = self._way.next()
        plans.tick += 1
        return self._last.copy()

    def take_events(self) -> tuple[str, ...]:
        """What a person should know of, since the last call: late plans, and plans that came to their end."""
        events, self.plans.events = tuple(self.plans.events), []
        return events

    def close(self) -> None:
        """End the planner."""
        self.plans.planner.close()

    @property
    def _last(self) -> Array:
        assert self._target is not None
        return self._target

    def _see(self, row: Array, applied: Array) -> None:
        """Take in raw rows `(..., raw size)` and the targets that ran before; a world that begins holds its pose."""
        fresh = self._history.fresh
        self._history.add(row, applied)
        if self._target is None:
            self._target = applied
        elif fresh.any():  # some worlds of many
            self._target, self._way = np.where(fresh[..., None], applied, self._target), None
            self.plans.hold(fresh, row, self._history.ran)

    def _meanwhile(self, row: Array) -> list[Array]:
        """The actions of the next `delay` ticks, as long as no other plan comes."""
        plans, delay = self.plans, self.plans.pace.delay
        actions = [plans.action(ahead) for ahead in range(min(plans.left, delay))]
        if len(actions) < delay:
            last = self._space.decode(row, actions[-1]) if actions else self._last
            way = self._way
            if way is None:
                way = self._stand(last) if self._stand and plans.latest is not None else MinJerk(last, last, 1)
            actions += [self._space.encode(row, way.ahead(1 + n)) for n in range(delay - len(actions))]
        return actions


def diffusion_policy(
    robot: Robot,
    settings: DiffusionSettings | None = None,
    cost: Cost | None = None,
    *,
    process: bool = False,
    shape: tuple[int, ...] = (),
) -> DiffusionPolicy:
    """The diffusion policy for `robot`, by default as configs/policies/diffusion.yaml says; `shape`: of many worlds.

    `cost` guides its plans until the robot shall stand, `Task.objective` for one; with `process`, which is for real
    time, it must be picklable and depend on nothing but its arguments. Raises ConfigError, also where checkpoint,
    settings and robot do not fit.
    """
    settings = settings or load_settings()
    path = resolve(settings.checkpoint, robot)
    settings = replace(settings, checkpoint=str(path))
    cost = None if cost is None else Stopping(cost)
    head = read_header(path)
    config = check_fit(path, head, robot)
    settings.check(config, head.get("training"))  # here, with a plain error, rather than in the planner's process
    space = load_action_space(path, robot)
    planner: Planner
    if process and not settings.delay:
        raise ConfigError(
            "diffusion policy: delay 0 needs plans that take no time: in real time set delay to 1 or more"
        )
    if process:
        planner = ProcessPlanner(partial(_build, robot, settings, cost))
    else:
        planner = InlinePlanner(_build(robot, settings, cost))
    return executing(planner, robot, settings, config.history, space=space, wait=not process, shape=shape)


def executing(
    planner: Planner,
    robot: Robot,
    settings: DiffusionSettings,
    history: int,
    *,
    space: ActionSpace = JOINT_TARGETS,
    wait: bool = True,
    shape: tuple[int, ...] = (),
) -> DiffusionPolicy:
    """The policy that executes the plans of `planner`, at the pace of `settings`, made from so many states."""
    trim = Trim(robot, settings.trim, shape) if settings.trim else None
    pace = Pace(history, settings.execution_horizon, settings.delay, wait=wait)

    def stand(pose: Array) -> MinJerk:
        return MinJerk(pose, robot.home, round(STAND_SECONDS * robot.rate))

    return DiffusionPolicy(planner, pace, trim=trim, space=space, stand=stand, shape=shape)


def _build(robot: Robot, settings: DiffusionSettings, cost: Cost | None) -> Answer:
    from servoid.policy.diffusion.runtime import load_runtime

    runtime = load_runtime(robot, settings, cost)
    runtime.warm_up()
    return partial(_plan, runtime)


def _plan(runtime: Runtime, request: PlanRequest) -> Plan:
    """The plan of a request, or why there is none."""
    from servoid.policy.diffusion.guidance import Diverged

    try:
        return runtime.plan(request)
    except Diverged as error:
        nothing = np.full((1, 1), np.nan)
        return Plan(request.tick, nothing, nothing, nothing, 0.0, str(error))

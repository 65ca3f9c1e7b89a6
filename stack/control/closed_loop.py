"""Planning in a closed loop (CLoSD): a planner says how the body moves next, and a tracker follows that.

The motion that was executed, as the estimator saw it, is the prefix of the next plan. Plans are asked for at a steady
pace and, besides, when another sentence is told; they are made beside the loop and adopted at their tick, so that a run
can be repeated from its log. Until the first plan the robot holds its pose.
"""

from __future__ import annotations

from collections.abc import Callable, Mapping, Sequence
from dataclasses import dataclass
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from servoid.hw.config import ConfigError, load_yaml
from servoid.hw.config import resolve as find
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Adopted, Instruction, Plan, PlanRequest, State
from servoid.hw.robot.description import Robot
from servoid.policy.checkpoint import CheckpointError, read_header, resolve
from servoid.policy.diffusion.model.action_space import JOINT_TARGETS
from servoid.policy.diffusion.prefix.config import check_fit
from servoid.policy.diffusion.prefix.frames import Frames
from servoid.policy.diffusion.prefix.planning import Planning, check, history_ticks
from servoid.policy.features import raw_row
from servoid.policy.references.plan import PlanReference, row_layout
from servoid.stack.control.base import BasePolicy
from servoid.stack.control.planning.plan_buffer import History, Pace, PlanBuffer
from servoid.stack.control.planning.planner import Answer, InlinePlanner, Planner, ProcessPlanner
from servoid.stack.control.tracker import Followers

if TYPE_CHECKING:
    from servoid.policy.diffusion.prefix.runtime import PlannerRuntime

_NOW = np.array([0])
Each = Callable[[], Sequence[Instruction]]  # what each of many worlds is asked by the plan that is due


@dataclass(frozen=True, kw_only=True)
class ClosedLoopSettings(Planning):
    """Settings of the policy (`configs/policies/closd.yaml`)."""

    checkpoint: str = "planner"  # a shipped one, or the path of a .safetensors file
    tracker: str = ""  # likewise, of a tracker of any reference; empty: the plan's joints are the goals
    walker: str = "expert"  # likewise, of a tracker of the gait, where a plan walks; empty: the tracker walks, too


class ClosedLoopPolicy(BasePolicy):
    """Follows plans, of one robot or of worlds of any leading `shape`."""

    def __init__(
        self, robot: Robot, planner: Planner, pace: Pace, stride: int, history: int, tracker: Followers | None = None,
        shape: tuple[int, ...] = (),
    ) -> None:  # fmt: skip
        """`stride` are the ticks of a frame, `history` those of states that the planner is given."""
        self.plans = PlanBuffer(planner, pace, shape)
        self.reference = PlanReference(robot, shape)  # what is followed
        self._tracker = tracker
        self._layout, self._robot, self._shape, self._stride = row_layout(robot), robot, shape, stride
        self._history = History(history, JOINT_TARGETS, shape)
        self._told: tuple[str | None, bool] = (None, False)  # with the last request
        self._fresh = np.ones(shape, bool)

    @property
    def adopted(self) -> Adopted | None:
        return self.plans.adopted

    def repeat(self, plans: Mapping[int, int]) -> None:
        self.plans.repeat(plans)

    def take_events(self) -> tuple[str, ...]:
        events, self.plans.events = tuple(self.plans.events), []
        return events

    def close(self) -> None:
        self.plans.planner.close()

    def reset(self, where: Array | None, seeds: Array) -> None:
        where = np.ones(self._shape, bool) if where is None else where
        self._history.reset(where)
        self._fresh = self._fresh | where
        if where.all():
            self.plans.reset()
            self._told = (None, False)
        if self._tracker is not None:
            self._tracker.reset(where)
        self.plans.seed(where, seeds)

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        """Joint targets `(..., n_joints)` rad for this tick. Raises PlannerError when the planner cannot plan any
        more. A sentence or a target that it cannot plan for is an event, and the last plan goes on."""
        reference = self.follow(state, applied, instruction)
        if self._tracker is None:
            target = reference.frames(_NOW).position[..., 0, :]
        else:
            target = self._tracker(state, applied, reference)
        self.advance()
        return target

    def follow(self, state: State, applied: Array, instruction: Instruction) -> PlanReference:
        """Plan where that is due, and go over to a plan that is there: the `reference` at this tick, for whoever tracks
        it, and calls `advance` then."""
        plans, applied = self.plans, np.array(applied, dtype=float)
        self._see(state, applied)
        plans.adopt()
        told = instruction.text, instruction.stand
        # Frames of one plan go on from those of another: a plan begins when a frame does.
        changed = told != self._told and plans.latest is not None and plans.tick % self._stride == 0
        if plans.due or (changed and plans.free):
            self._told = told
            plans.ask(self._history, [], instruction)
        if plans.adopted is not None:
            plan = plans.adopted.plan
            self.reference.follow(np.asarray(plan.actions, dtype=float)[..., plans.tick - plan.tick :, :])
        elif plans.latest is not None and not plans.left:
            plans.end("its last pose is held")
        return self.reference

    def advance(self) -> None:
        """Go on by a tick."""
        self.reference.advance()
        self.plans.tick += 1

    def _see(self, state: State, applied: Array) -> None:
        """Take in the state; a world that begins holds its pose until a plan comes that was asked for since."""
        self._history.add(raw_row(state), applied)
        if not self._fresh.any():
            return
        fresh, self._fresh = self._fresh, np.zeros_like(self._fresh)
        if fresh.all():
            self.reference.stand(applied)
            return
        self.reference.stand(applied, fresh)
        if self.plans.latest is not None:
            held = np.zeros((*self._shape, self.plans.latest.states.shape[-1]))
            self.plans.hold(fresh, held, self._pose(applied))

    def _pose(self, joints: Array) -> Array:
        """Rows of standing with joints `(..., n_joints)`."""
        row = np.ones((*self._shape, self._layout.size))
        row[..., self._layout.slice("place")] = [0.0, 0.0, self._robot.standing_height]
        row[..., self._layout.slice("orientation")] = [1.0, 0.0, 0.0, 0.0]
        row[..., self._layout.slice("position")] = joints
        return row


def load_settings(name: str = "closd") -> ClosedLoopSettings:
    """By a name in configs/policies/, or by file. Raises ConfigError."""
    return load_yaml(find("policies", name), ClosedLoopSettings)


def closed_loop_policy(
    robot: Robot,
    settings: ClosedLoopSettings | None = None,
    *,
    process: bool = False,
    shape: tuple[int, ...] = (),
    each: Each | None = None,
) -> ClosedLoopPolicy:
    """The policy for `robot`, by default as configs/policies/closd.yaml says; `shape`: of many worlds, and `each`: what
    each of them is asked, where that is not the same.

    With `process` a planner runs beside the loop. Raises ConfigError, also where checkpoint, settings and robot do not
    fit, and where the tracker knows the gait alone.
    """
    settings = settings or load_settings()
    path, frames = _checkpoint(settings.checkpoint, robot), Frames(robot)
    config = check_fit(path, read_header(path), robot, frames)
    wrong = check(settings, frames.stride, config.levels)
    if process and not settings.delay:
        wrong.append("delay 0 needs plans that take no time: in real time set it to a frame or more")
    if wrong:
        raise ConfigError(f"closed loop: {'; '.join(wrong)}")
    tracker = Followers(robot, settings.tracker, settings.walker, shape) if settings.tracker else None
    build = partial(_build, robot, str(path), settings)
    planner: Planner = ProcessPlanner(build) if process else InlinePlanner(build(each))
    pace = Pace(1, settings.frames * frames.stride, settings.delay, wait=not process)
    history = history_ticks(config.prefix, frames.stride)
    return ClosedLoopPolicy(robot, planner, pace, frames.stride, history, tracker, shape)


def _checkpoint(name: str, robot: Robot) -> Path:
    try:
        return resolve(name, robot)
    except CheckpointError as error:
        raise CheckpointError(
            f"{error}. Train a planner with `servoid train planner --out runs/planner`, and give its file: "
            "--policy runs/planner/planner.safetensors"
        ) from None


def _build(robot: Robot, path: str, settings: ClosedLoopSettings, each: Each | None = None) -> Answer:
    from servoid.policy.diffusion.prefix.model import load
    from servoid.policy.diffusion.prefix.runtime import PlannerRuntime

    frames = Frames(robot)
    runtime = PlannerRuntime(load(Path(path), robot, frames), robot, frames, settings)
    runtime.warm_up()
    return partial(_plan, runtime, each)


def _plan(runtime: PlannerRuntime, each: Each | None, request: PlanRequest) -> Plan:
    """The plan of a request, or why there is none: the last one then goes on, and the robot holds its last pose."""
    try:
        return runtime.plan(request, None if each is None else each())
    except ConfigError as error:  # what was asked cannot be understood
        nothing = np.full((1, 1), np.nan)
        return Plan(request.tick, nothing, nothing, nothing, 0.0, str(error))

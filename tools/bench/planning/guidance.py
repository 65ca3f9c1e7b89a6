"""Ways to guide a planner beside each other: what each makes of a plan's cost, of its likeness to the data, of a robot.

Robots walk side by side to goals all around them, by the goal's distance and bearing alone. Some of the plans are made
once more without guidance, from the same noise: what guidance changed is the difference.
"""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, field, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from servoid.tools.common.output import Report, add_json_argument, reporting

if TYPE_CHECKING:
    from servoid.hw.contracts.body import Array
    from servoid.hw.contracts.control import Plan, PlanRequest
    from servoid.hw.robot.description import Robot
    from servoid.policy.diffusion.runtime import Runtime
    from servoid.policy.diffusion.settings import DiffusionSettings

TASK = "goal-far"
DISTANCES = (0.28, 1.65)  # m of the goals: those of goal-near and goal-far
EVERY = 5  # of this many plans one is made without guidance, too

# Changes of `guidance`. All but the first are complete: what a file of settings says besides does not count.
_PAPER: dict[str, Any] = {
    "gradient": "network", "weight": 3000.0, "clip": 20.0,
    "scaled": False, "even": False, "limited": False, "repeats": 1, "actions": False,
}  # fmt: skip
VARIANTS: dict[str, dict[str, Any]] = {
    "settings": {},
    "actions": {"actions": True},
    "paper": _PAPER,
    "half-clip": _PAPER | {"clip": 10.0},
    "limited": _PAPER | {"limited": True},
    "even": _PAPER | {"even": True},
    "repeats-3": _PAPER | {"repeats": 3},
    "scaled": _PAPER | {"scaled": True, "weight": 1000.0},
    "scaled-300": _PAPER | {"scaled": True, "weight": 300.0},
    "states": _PAPER | {"gradient": "analytic"},
}
COLUMNS = (
    "variant", "success", "fell", "seconds", "tilt_deg", "cost_before", "cost_after", "lowered", "error_before",
    "error_after", "plan_cpu_ms",
)  # fmt: skip


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `servoid bench guidance`."""
    from servoid.tools.common.parser import positive

    parser.add_argument(
        "--policy", default="lookahead", metavar="NAME|FILE", help="settings of the planner (default: lookahead)"
    )
    parser.add_argument("--episodes", type=int, default=24, metavar="N", help="goals of each variant (default: 24)")
    parser.add_argument(
        "--seconds", type=positive, default=13.0, metavar="S", help="time to come to a goal (default: %(default)g)"
    )
    parser.add_argument("--seed", type=int, default=0, metavar="N", help="random seed (default: 0)")
    about = f"only this one of {', '.join(VARIANTS)}; may be repeated (default: all)"
    parser.add_argument("--variant", action="append", choices=VARIANTS, metavar="NAME", help=about)
    parser.add_argument(
        "--steps", type=int, metavar="N", help="network calls a plan, but for `lead` (default: its own)"
    )
    parser.add_argument("--checkpoint", metavar="NAME|FILE", help="another model with the same settings")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Walk, and print a row for each variant. Raises ConfigError."""
    with reporting(args.json) as report:
        _run(args, report)
    return 0


def _run(args: argparse.Namespace, report: Report) -> None:
    from servoid.hw.config import ConfigError
    from servoid.hw.robot.description import load_robot
    from servoid.policy.diffusion.settings import load_settings

    for name, least in (("episodes", 1), ("seed", 0)):
        if getattr(args, name) < least:
            raise ConfigError(f"--{name} must be at least {least}, not {getattr(args, name)}")
    robot, settings = load_robot(), load_settings(args.policy)
    if settings.guidance.samples > 1:
        settings = replace(settings, guidance=replace(settings.guidance, samples=1))
    if args.steps is not None:
        try:
            settings = replace(settings, steps=args.steps)
        except ValueError as error:
            raise ConfigError(f"--steps {args.steps}: {error}") from None
    settings = replace(settings, checkpoint=args.checkpoint or settings.checkpoint)
    rows = []
    for name in args.variant or VARIANTS:
        chosen = replace(settings, guidance=replace(settings.guidance, **VARIANTS[name]))
        rows.append({"variant": name, **_walk(robot, chosen, args.episodes, args.seconds, args.seed)})
        report.line(f"{name}: {rows[-1]['arrived']} of {args.episodes} arrived, {rows[-1]['fallen']} fell")
    report.table(COLUMNS, [[_cell(row[key]) for key in COLUMNS] for row in rows])
    report.result({"policy": args.policy, "episodes": args.episodes, "seconds": args.seconds, "rows": rows})


@dataclass
class _Measured:
    """An answer to plan requests that makes some plans once more, unguided, and keeps what both are worth."""

    guided: Runtime
    unguided: Runtime
    dt: float
    count: int = 0
    seconds: float = 0.0  # of the processor, for all guided plans
    active: Array = field(default_factory=lambda: np.zeros(0, bool))  # (n,) robots still on their way
    values: list[Array] = field(default_factory=list)  # (4, robots): cost and error, of both

    def __call__(self, request: PlanRequest) -> Plan:
        from servoid.hw.contracts.control import Plan
        from servoid.policy.diffusion.guidance import Diverged

        start = time.process_time()
        try:
            plan = self.guided.plan(request)
        except Diverged as error:
            nothing = np.full((1, 1), np.nan)
            return Plan(request.tick, nothing, nothing, nothing, 0.0, str(error))
        finally:
            self.seconds += time.process_time() - start
            self.count += 1
        if self.count % EVERY == 1:
            self._compare(request, plan)
        return plan

    def _compare(self, request: PlanRequest, guided: Plan) -> None:
        from servoid.policy.diffusion.plan_quality import denoising_error, plan_cost

        cost = self.guided.cost
        assert cost is not None
        plans = self.unguided.plan(request), guided
        costs = [plan_cost(self.guided, request, plan, cost, self.dt) for plan in plans]
        errors = [denoising_error(self.guided, request, plan) for plan in plans]
        self.values.append(np.array([*costs, *errors])[:, self.active])


def _walk(robot: Robot, settings: DiffusionSettings, n: int, seconds: float, seed: int) -> dict[str, Any]:
    """What comes of `n` goals. Raises ConfigError."""
    from servoid.hw.contracts.control import Instruction
    from servoid.hw.geometry import turned
    from servoid.policy.diffusion.runtime import load_runtime
    from servoid.stack.control.diffusion import executing
    from servoid.stack.control.fleet import Fleet
    from servoid.stack.control.planning.planner import InlinePlanner
    from servoid.stack.estimation.odometry import load_odometry
    from servoid.stack.tasks import load_task
    from servoid.stack.tasks.goal import GoalSettings

    task = load_task(TASK, {"way": "cost"}, robot.dt)
    assert isinstance(task.settings, GoalSettings)
    unguided = replace(settings, guidance=replace(settings.guidance, weight=0.0))
    answer = _Measured(load_runtime(robot, settings, task.objective), load_runtime(robot, unguided), robot.dt)
    model = answer.guided.model
    policy = executing(InlinePlanner(answer), robot, settings, model.config.history, space=model.space, shape=(n,))
    fleet = Fleet(robot, n, load_odometry(robot), seed=seed)
    fleet.reset(np.ones(n, bool))
    policy.reset(None, fleet.seeds)
    state, truth = fleet.observe(), fleet.truth
    rng = np.random.default_rng(seed)
    distance, bearing = rng.uniform(*DISTANCES, n), rng.uniform(-np.pi, np.pi, n)
    goal = truth.position[:, :2] + distance[:, None] * np.stack([np.cos(bearing), np.sin(bearing)], -1)
    arrived, fell, tilt = np.full(n, np.nan), np.full(n, np.nan), np.zeros(n)
    for tick in range(round(seconds * robot.rate)):
        ahead = turned(goal - truth.position[:, :2], -truth.yaw)
        on_way = np.isnan(arrived) & np.isnan(fell)
        arrived[on_way & (np.linalg.norm(ahead, axis=-1) <= task.settings.arrive)] = tick * robot.dt
        fell[on_way & truth.fallen] = tick * robot.dt
        answer.active = np.isnan(arrived) & np.isnan(fell)
        if not answer.active.any():
            break
        lean = np.degrees(np.arccos(np.clip(-truth.gravity[:, 2], -1.0, 1.0)))
        tilt = np.where(answer.active, np.maximum(tilt, lean), tilt)
        asked = task.settings.asked(Instruction(np.zeros((n, 3)), goal=ahead))
        fleet.step(policy.act(state, fleet.applied, asked))
        state, truth = fleet.observe(), fleet.truth
    there = np.isfinite(arrived)
    before, after, error_before, error_after = np.concatenate(answer.values, 1)
    return {
        "arrived": int(there.sum()),
        "fallen": int(np.isfinite(fell).sum()),
        "success": float(there.mean()),
        "fell": float(np.isfinite(fell).mean()),
        "seconds": float(np.mean(arrived[there])) if there.any() else None,
        "tilt_deg": float(np.median(tilt)),
        "cost_before": float(before.mean()),
        "cost_after": float(after.mean()),
        "lowered": float((after < before).mean()),
        "error_before": float(error_before.mean()),
        "error_after": float(error_after.mean()),
        "plan_cpu_ms": 1000.0 * answer.seconds / answer.count / n,
    }


def _cell(value: object) -> str:
    return f"{value:.3g}" if isinstance(value, float) else str(value)

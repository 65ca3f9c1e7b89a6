"""`servoid bench policy`: how long the diffusion policy takes for a plan, on one thread."""

from __future__ import annotations

import argparse
import time
from typing import TYPE_CHECKING, Any

import numpy as np

from tools.output import Report, add_json_argument, reporting

if TYPE_CHECKING:
    import torch

    from hw.hal import PlanRequest
    from hw.robot import Robot
    from policy.diffusion.checkpoint import Model
    from policy.diffusion.runtime import Runtime
    from policy.diffusion.settings import DiffusionSettings

RANDOM = "random"
WARM_UP = 5  # plans before the clock counts


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `servoid bench policy`."""
    parser.add_argument("--checkpoint", help=f"name or file; '{RANDOM}': weights made up (default: the shipped one)")
    parser.add_argument("--robot", default="op3", help="robot name or file (default op3)")
    parser.add_argument("--plans", type=int, default=200, help="plans to time, guided and unguided each (default 200)")
    parser.add_argument("--width", type=int, default=192, help="width of made-up weights (default 192)")
    parser.add_argument("--layers", type=int, default=2, help="layers of made-up weights (default 2)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Time plans and print a row for each engine, runtime and kind of guidance. Raises ConfigError."""
    with reporting(args.json) as report:
        _run(args, report)
    return 0


def _run(args: argparse.Namespace, report: Report) -> None:
    from dataclasses import replace

    from hw.config import ConfigError
    from hw.robot import load_robot
    from policy.diffusion.runtime import Runtime
    from policy.diffusion.settings import load_settings
    from stack.tasks import load_task

    if args.plans < 1:
        raise ConfigError(f"--plans must be at least 1, not {args.plans}")
    robot, settings = load_robot(args.robot), load_settings()
    name, model = _model(args, robot, settings)
    cost = load_task("walk", dt=robot.dt).cost
    request = _request(robot, model.config.history, settings.delay)
    rows = []
    for guided, gradient in ((False, "none"), (True, "analytic"), (True, "network")):
        guidance = replace(settings.guidance, gradient=gradient if guided else "analytic")
        guidance = replace(guidance, weight=guidance.weight or 1.0)  # timed even where it is switched off
        chosen = replace(settings, guidance=guidance)
        runtime = Runtime(model, chosen, robot.dt, cost if guided else None)
        rows.append(_row(runtime, request, args.plans, guided, gradient))
    between = 1000 * settings.replan * robot.dt
    keys = ("engine", "runtime", "gradient", "calls_per_plan", "call_median_ms", "plan_median_ms", "plan_p99_ms")
    report.line(f"{name}: {rows[0]['parameters']:,} parameters, {rows[0]['tokens']} tokens, one thread")
    report.table(keys, [[_cell(row[key]) for key in keys] for row in rows])
    report.line(f"a plan is due every {between:g} ms")
    report.result({"checkpoint": name, "ms_between_plans": between, "rows": rows})


def _model(args: argparse.Namespace, robot: Robot, settings: DiffusionSettings) -> tuple[str, Model]:
    """The network to time and its name. Without a shipped checkpoint, one with random weights."""
    from policy.checkpoint import CheckpointError, resolve
    from policy.diffusion.checkpoint import load

    if args.checkpoint != RANDOM:
        try:
            path = resolve(args.checkpoint or settings.checkpoint)
        except CheckpointError:
            if args.checkpoint:
                raise
        else:
            return path.stem, load(path, robot)
    return RANDOM, _random_model(robot, args.layers, args.width)


def _random_model(robot: Robot, layers: int, width: int) -> Model:
    import torch

    from policy.diffusion.checkpoint import Model
    from policy.diffusion.config import DenoiserConfig
    from policy.diffusion.denoiser import Denoiser
    from policy.diffusion.features import Normaliser, token_layout

    torch.manual_seed(0)
    n = len(robot.joints)
    size = token_layout(n).size
    denoiser = Denoiser(DenoiserConfig(size, n, layers=layers, width=width)).eval().requires_grad_(False)
    states = Normaliser(torch.zeros(size), torch.full((size,), 0.1))
    actions = Normaliser(torch.as_tensor(robot.home, dtype=torch.float32), torch.full((n,), 0.1))
    return Model(denoiser, states, actions, {})


def _request(robot: Robot, history: int, delay: int) -> PlanRequest:
    """A robot that stands at home."""
    from hw.hal import Instruction, PlanRequest
    from policy.diffusion.features import raw_layout

    layout = raw_layout(len(robot.joints))
    row = np.zeros(layout.size, dtype=np.float32)
    row[layout.slice("displacement")] = 0.0, 0.0, robot.standing_height
    row[layout.slice("gravity")] = 0.0, 0.0, -1.0
    row[layout.slice("position")] = robot.home
    states, actions = np.tile(row, (history, 1)), np.tile(robot.home, (history - 1 + delay, 1))
    return PlanRequest(0, states, actions, Instruction(np.array([0.2, 0.0, 0.0]), np.array([1.0, 0.0])))


def _row(runtime: Runtime, request: PlanRequest, plans: int, guided: bool, gradient: str) -> dict[str, Any]:
    """Times of `plans` plans, and of as many single network calls."""
    for i in range(WARM_UP):
        runtime.plan(request, i)
    plan_ms = []
    for i in range(plans):
        start = time.perf_counter()
        runtime.plan(request, i)
        plan_ms.append(1000 * (time.perf_counter() - start))
    call_ms = _call_times(runtime, plans)
    config = runtime.model.config
    return {
        "engine": "torch",
        "runtime": "chunk",
        "guided": guided,
        "gradient": gradient,
        "parameters": runtime.model.denoiser.parameter_count,
        "tokens": config.tokens,
        "calls_per_plan": runtime.matrix.calls,
        "call_median_ms": float(np.median(call_ms)),
        "call_p99_ms": float(np.percentile(call_ms, 99)),
        "plan_median_ms": float(np.median(plan_ms)),
        "plan_p99_ms": float(np.percentile(plan_ms, 99)),
        "plans_per_s": 1000 / float(np.mean(plan_ms)),
    }


def _call_times(runtime: Runtime, calls: int) -> list[float]:
    """Milliseconds of single network calls for one robot."""
    import torch

    from policy.diffusion.runtime import one_thread

    config = runtime.model.config
    n_states, n_actions = len(config.state_ticks), len(config.action_ticks)
    inputs: tuple[torch.Tensor, ...] = (
        torch.zeros(1, n_states, config.state_size),
        torch.zeros(1, n_actions, config.action_size),
        torch.full((n_states,), config.levels),
        torch.full((n_actions,), config.levels),
    )
    times = []
    with one_thread(), torch.inference_mode():
        for i in range(WARM_UP + calls):
            start = time.perf_counter()
            runtime.model.denoiser(*inputs)
            if i >= WARM_UP:
                times.append(1000 * (time.perf_counter() - start))
    return times


def _cell(value: object) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)

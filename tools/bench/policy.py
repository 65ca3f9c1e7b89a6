"""Time the plans of the diffusion policy on one thread, by engine and runtime."""

from __future__ import annotations

import argparse
import time
from dataclasses import dataclass, replace
from typing import TYPE_CHECKING, Any

import numpy as np

from servoid.tools.common.output import Report, add_json_argument, reporting

if TYPE_CHECKING:
    import torch

    from servoid.hw.contracts.control import PlanRequest
    from servoid.hw.robot.description import Robot
    from servoid.policy.diffusion.engines import Engine
    from servoid.policy.diffusion.model.checkpoint import Model
    from servoid.policy.diffusion.runtime import Runtime
    from servoid.policy.diffusion.settings import DiffusionSettings

RANDOM = "random"
NONE = "none"
PAPER_SHAPE = "4,32,16"  # of Diffuse-CLoC
RUNTIMES = {"chunked": "diffusion", "rolling": "diffuse_cloc"}  # and the settings that each is timed with
WARM_UP = 5  # plans before the clock counts
PEAK_SIZE = 768  # rows of the square matrices that the peak is measured with
COLUMNS = (
    "network",
    "engine",
    "runtime",
    "gradient",
    "calls_per_plan",
    "call_median_ms",
    "plan_median_ms",
    "plan_p99_ms",
    "plan_cpu_ms",
    "plan_per_call",
    "plan_per_pass",
    "plans_per_s",
    "gflops",
)


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `servoid bench policy`."""
    parser.add_argument(
        "--checkpoint", metavar="NAME|FILE", help=f"checkpoint; '{RANDOM}': random weights (default: the shipped one)"
    )
    parser.add_argument("--robot", default="op3", metavar="NAME|FILE", help="robot (default: op3)")
    parser.add_argument("--plans", type=int, default=100, metavar="N", help="plans to time for each row (default: 100)")
    parser.add_argument(
        "--width", type=int, default=192, metavar="N", help="width of a network with random weights (default: 192)"
    )
    parser.add_argument(
        "--layers", type=int, default=2, metavar="N", help="layers of a network with random weights (default: 2)"
    )
    parser.add_argument(
        "--shape",
        default=PAPER_SHAPE,
        metavar="PAST,STATES,ACTIONS",
        help="window of a second network, as wide and deep as the checkpoint's, with random weights: states up to the "
        f"present, states to come, actions to come; '{NONE}': no second network (default {PAPER_SHAPE})",
    )
    parser.add_argument(
        "--engine",
        action="append",
        metavar="NAME",
        help="only this engine; may be repeated (default: all that are installed)",
    )
    parser.add_argument("--runtime", choices=RUNTIMES, help="only this runtime (default: both)")
    add_json_argument(parser)


def main(args: argparse.Namespace) -> int:
    """Time plans and print a row for each network, engine, runtime and kind of guidance. Raises ConfigError."""
    with reporting(args.json) as report:
        _run(args, report)
    return 0


@dataclass(frozen=True)
class Network:
    """A network to time; `gflop` are the floating-point operations of one call, 1e9."""

    name: str
    model: Model
    gflop: float


def _run(args: argparse.Namespace, report: Report) -> None:
    from tqdm import tqdm

    from servoid.hw.config import ConfigError
    from servoid.hw.robot.description import load_robot
    from servoid.policy.diffusion.engines import ENGINES, check_engine, load_engine
    from servoid.policy.diffusion.settings import load_settings

    if args.plans < 1:
        raise ConfigError(f"--plans must be at least 1, not {args.plans}")
    robot = load_robot(args.robot)
    runtimes = {name: load_settings(file) for name, file in RUNTIMES.items() if args.runtime in (None, name)}
    for engine in args.engine or ():
        check_engine(engine)
    networks = _networks(args, robot)
    skipped: dict[str, str] = {}
    rows = []
    pairs = [(network, engine) for network in networks for engine in args.engine or ENGINES]
    for network, engine in tqdm(pairs, unit="engine", leave=False, disable=None):
        try:
            loaded = load_engine(engine, network.model.denoiser, ENGINES[engine].gradient)
        except ConfigError as error:
            skipped[f"{network.name}: {engine}"] = str(error)
            continue
        timed = _Timed(engine, loaded, _call_times(loaded, network.model, args.plans))
        for runtime, settings in runtimes.items():
            rows += _time(network, timed, runtime, settings, robot, args.plans)
    peak = peak_gflops()
    for row in rows:
        row["peak_gflops"] = peak
    for network in networks:
        config = network.model.config
        report.line(f"{network.name}: {network.model.denoiser.parameter_count:,} parameters, {config.tokens} tokens")
    report.table(COLUMNS, [[_cell(row[key]) for key in COLUMNS] for row in rows])
    due = ", ".join(f"{name} after {due_ms(settings, robot.dt):g} ms" for name, settings in runtimes.items())
    report.line(f"one thread, peak {peak:.0f} GFLOP/s; a plan is due: {due}")
    for what, reason in skipped.items():
        report.line(f"skipped {what}: {reason}")
    report.result(
        {
            "checkpoint": networks[0].name,
            "plan_due_ms": due_ms(next(iter(runtimes.values())), robot.dt),
            "rows": rows,
            "skipped": skipped,
        }
    )


def due_ms(settings: DiffusionSettings, dt: float) -> float:
    """Milliseconds after its request by which a plan must be there: `delay`, or else `execution_horizon`."""
    return 1000 * (settings.delay or settings.execution_horizon) * dt


@dataclass(frozen=True)
class _Timed:
    """An engine with the times of single calls, which are the same in all of its rows."""

    name: str
    engine: Engine
    call_ms: list[float]


def _time(
    network: Network, timed: _Timed, runtime: str, settings: DiffusionSettings, robot: Robot, plans: int
) -> list[dict[str, Any]]:
    """Rows of one engine and runtime: unguided, and guided by each kind of gradient that the engine has."""
    from servoid.policy.diffusion.engines import ENGINES
    from servoid.policy.diffusion.runtime import Runtime
    from servoid.stack.tasks import load_task
    from servoid.tools.bench.planning.counted import CountedEngine

    cost = load_task("walk", dt=robot.dt).objective
    request = _request(robot, network.model, settings.delay)
    rows = []
    for gradient in (NONE, "analytic", "network") if ENGINES[timed.name].gradient else (NONE, "analytic"):
        guided = gradient != NONE
        guidance = replace(settings.guidance, gradient=gradient if guided else "analytic")
        guidance = replace(guidance, weight=guidance.weight or 1.0)  # timed even where it is switched off
        chosen = replace(settings, engine=timed.name, guidance=guidance)
        engine = CountedEngine(timed.engine)
        planner = Runtime(network.model, chosen, robot, cost if guided else None, engine.engine)
        _plan_times(planner, request, WARM_UP)
        engine.clear()
        plan_ms, cpu_ms = _plan_times(planner, request, plans)
        rows.append(
            {
                "network": network.name,
                "engine": timed.name,
                "runtime": runtime,
                "guided": guided,
                "gradient": gradient,
                "parameters": network.model.denoiser.parameter_count,
                "tokens": network.model.config.tokens,
                "calls_per_plan": planner.matrix.calls,
                "call_median_ms": float(np.median(timed.call_ms)),
                "call_p99_ms": float(np.percentile(timed.call_ms, 99)),
                "plan_median_ms": float(np.median(plan_ms)),
                "plan_p99_ms": float(np.percentile(plan_ms, 99)),
                "plan_cpu_ms": float(np.median(cpu_ms)),
                "plan_per_call": sum(cpu_ms) / (1000 * engine.seconds),
                "plan_per_pass": sum(cpu_ms) / (1000 * (engine.seconds + engine.back)),
                "plans_per_s": 1000 / float(np.median(plan_ms)),
                "plan_due_ms": due_ms(settings, robot.dt),
                "gflops": network.gflop / (float(np.median(timed.call_ms)) / 1000),
            }
        )
    return rows


def _networks(args: argparse.Namespace, robot: Robot) -> list[Network]:
    """The checkpoint, or one with random weights without it, and the network of `--shape`."""
    from servoid.policy.checkpoint import CheckpointError, resolve
    from servoid.policy.diffusion.model.checkpoint import load
    from servoid.policy.diffusion.model.config import DenoiserConfig
    from servoid.policy.diffusion.settings import load_settings
    from servoid.policy.features import Normaliser, token_layout

    name, model = RANDOM, None
    if args.checkpoint != RANDOM:
        try:
            path = resolve(args.checkpoint or load_settings().checkpoint)
        except CheckpointError:
            if args.checkpoint:
                raise
        else:
            name, model = path.stem, load(path, robot)
    if model is None:
        import torch

        n = len(robot.joints)
        size = token_layout(n).size
        states = Normaliser(torch.zeros(size), torch.full((size,), 0.1))
        actions = Normaliser(torch.as_tensor(robot.home, dtype=torch.float32), torch.full((n,), 0.1))
        config = DenoiserConfig(size, n, layers=args.layers, width=args.width)
        model = _made_up(config, states, actions)
    networks = [Network(name, model, _gflop(model))]
    if args.shape != NONE:
        past, horizon, actions_to_come = _shape(args.shape)
        config = replace(model.config, history=past, horizon=horizon, actions=actions_to_come)
        second = replace(_made_up(config, model.states, model.actions), space=model.space)
        networks.append(Network(args.shape, second, _gflop(second)))
    return networks


def _shape(text: str) -> tuple[int, int, int]:
    """Past states, states and actions to come. Raises ConfigError."""
    from servoid.hw.config import ConfigError

    try:
        past, states, actions = (int(part) for part in text.split(","))
    except ValueError:
        raise ConfigError(f"--shape: three whole numbers, {PAPER_SHAPE} for one, or '{NONE}', not '{text}'") from None
    return past, states, actions


def _made_up(config: Any, states: Any, actions: Any) -> Model:
    """A network of this shape with random weights, the same every time."""
    import torch

    from servoid.policy.diffusion.model.checkpoint import Model
    from servoid.policy.diffusion.model.denoiser import Denoiser

    torch.manual_seed(0)
    return Model(Denoiser(config).eval().requires_grad_(False), states, actions, {})


def _request(robot: Robot, model: Model, delay: int) -> PlanRequest:
    """A robot that stands at home."""
    from servoid.hw.contracts.control import Instruction, PlanRequest
    from servoid.policy.features import raw_layout

    layout = raw_layout(len(robot.joints))
    row = np.zeros(layout.size, dtype=np.float32)
    row[layout.slice("displacement")] = 0.0, 0.0, robot.standing_height
    row[layout.slice("gravity")] = 0.0, 0.0, -1.0
    row[layout.slice("position")] = robot.home
    history, action = model.config.history, model.space.encode(row, robot.home)
    states, actions = np.tile(row, (history, 1)), np.tile(action, (history - 1 + delay, 1))
    return PlanRequest(0, states, actions, Instruction(np.array([0.2, 0.0, 0.0]), goal=np.array([1.0, 0.0])))


def _plan_times(planner: Runtime, request: PlanRequest, plans: int) -> tuple[list[float], list[float]]:
    """Milliseconds of plans in a row, each `execution_horizon` ticks after the one before, which it may go on from.

    By the clock, and of the processor's time: on a machine that others use too only the second can be compared.
    """
    previous = None
    wall, cpu = [], []
    for i in range(plans):
        asked = replace(request, tick=i * planner.settings.execution_horizon, previous=previous)
        start, busy = time.perf_counter(), time.process_time()
        previous = planner.plan(asked)
        wall.append(1000 * (time.perf_counter() - start))
        cpu.append(1000 * (time.process_time() - busy))
    return wall, cpu


def _call_times(engine: Engine, model: Model, calls: int) -> list[float]:
    """Milliseconds of single network calls for one robot."""
    import torch

    from servoid.policy.diffusion.runtime import one_thread

    inputs, times = _inputs(model), []
    with one_thread(), torch.inference_mode():
        for i in range(WARM_UP + calls):
            start = time.perf_counter()
            engine(*inputs)
            if i >= WARM_UP:
                times.append(1000 * (time.perf_counter() - start))
    return times


def _inputs(model: Model) -> tuple[torch.Tensor, ...]:
    """A window of noise, with an instruction where the network reads one."""
    import torch

    config = model.config
    n_states, n_actions = len(config.state_ticks), len(config.action_ticks)
    generator = torch.Generator().manual_seed(0)
    inputs = (
        torch.randn(1, n_states, config.state_size, generator=generator),
        torch.randn(1, n_actions, config.action_size, generator=generator),
        torch.full((n_states,), config.levels),
        torch.full((n_actions,), config.levels),
    )
    return (*inputs, torch.zeros(1, config.text_size)) if config.text_size else inputs


def _gflop(model: Model) -> float:
    """Floating-point operations of one network call for one robot, 1e9; a multiplication and addition count as two."""
    import torch
    from torch.utils.flop_counter import FlopCounterMode

    counter = FlopCounterMode(display=False)
    with counter, torch.enable_grad():  # attention is spelled out then, so that it is counted
        model.denoiser(*_inputs(model))
    return float(counter.get_total_flops()) / 1e9


def peak_gflops(size: int = PEAK_SIZE, repeats: int = 12) -> float:
    """The best rate, 1e9 operations a second, of a float32 matrix product on one thread: this machine, as it is now."""
    import torch

    from servoid.policy.diffusion.runtime import one_thread

    a = torch.randn(size, size, generator=torch.Generator().manual_seed(0))
    out = torch.empty_like(a)
    with one_thread():
        best = float("inf")
        for _ in range(repeats):
            start = time.perf_counter()
            torch.mm(a, a, out=out)
            best = min(best, time.perf_counter() - start)
    return 2 * size**3 / best / 1e9


def _cell(value: object) -> str:
    return f"{value:.2f}" if isinstance(value, float) else str(value)

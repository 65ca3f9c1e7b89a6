"""`servoid train odometry`: learn the correction of leg odometry in randomised worlds, and measure the drift left."""

from __future__ import annotations

import argparse
import os
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import partial
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction

if TYPE_CHECKING:
    from servoid.hw.contracts.control import Policy

    MakePolicy = Callable[..., Policy]  # takes a shape

_CHUNK = 50  # ticks whose mean error is penalised beside each tick's: the mean is what drifts
_MEAN_WEIGHT = 20.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    parser.add_argument("--robot", default="op3", help="name or file (default: %(default)s)")
    parser.add_argument(
        "--policy", nargs="*", default=["expert", "diffusion"], metavar="NAME", help="what walks beside the gait"
    )
    parser.add_argument("--out", type=Path, default=Path("runs/odometry.safetensors"), help="checkpoint to write")
    parser.add_argument("--worlds", type=int, default=192)
    parser.add_argument("--seconds", type=float, default=60.0, help="of walking a world (default: %(default)s)")
    parser.add_argument("--steps", type=int, default=3000, help="of the optimiser (default: %(default)s)")
    parser.add_argument("--seed", type=int, default=0)
    parser.add_argument(
        "--measure",
        action="store_true",
        help="train nothing: how far is the odometry that is there off on these walks",
    )


def main(args: argparse.Namespace) -> int:
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # the worlds use the cores
    from servoid.hw.robot.description import load_robot
    from servoid.policy import checkpoint
    from servoid.stack.estimation.odometry import load_odometry

    robot = load_robot(args.robot)
    names = ["gait", *(name for name in args.policy if name != "gait")]
    makers = {name: maker(robot, name) for name in names}
    if args.measure:
        _measure(robot, makers, load_odometry(robot), args.seed)
        return 0
    known = _shipped(robot)
    data: dict[str, Array] | None = None
    for i, name in enumerate(names):  # every way of walking slips in its own way
        part = record(robot, makers[name], args.worlds // len(names), args.seconds, args.seed + i, known)
        data = part if data is None else mixed(data, part, args.seed)
    assert data is not None
    network = fit(data, args.steps, args.seed)
    results = _measure(robot, makers, network, args.seed)
    head = checkpoint.header(
        "odometry",
        robot,
        config={"hidden": [len(bias) for _, bias in network.layers[:-1]]},
        data=f"{args.worlds} randomised worlds, {args.seconds:g} s of {', '.join(names)}, seed {args.seed}",
        licence="Apache-2.0",
        results=results,
    )
    args.out.parent.mkdir(parents=True, exist_ok=True)
    network.save(args.out, head)
    print(f"wrote {args.out}")
    return 0


def _measure(robot: Any, makers: dict[str, MakePolicy], network: Any, seed: int) -> dict[str, float]:
    """Print the drift of each way of walking, by legs alone and corrected; returns what the checkpoint says of it."""
    results = {}
    for name, make in makers.items():
        for title, odometry in (("legs alone", None), ("corrected", network)):
            result = drift(robot, make, odometry, walks=64, seconds=30.0, seed=seed + 1)
            key = f"drift_p90_{name}" + ("_legs_alone" if odometry is None else "")
            results[key] = round(result.p90, 4)
            print(
                f"{name}, {title}: displacement error {100 * result.median:.1f} % of the path (median), "
                f"{100 * result.p90:.1f} % (90th percentile), yaw drift {result.yaw_p90:.3f} rad a minute "
                f"(90th percentile), {result.walks} walks"
            )
    return results


def _shipped(robot: Any) -> Any:
    """The odometry that is there already, or None."""
    from servoid.policy.checkpoint import CheckpointError
    from servoid.stack.estimation.odometry import load_odometry

    try:
        return load_odometry(robot)
    except CheckpointError:
        return None


def maker(robot: Any, name: str) -> MakePolicy:
    """What makes a policy for worlds of a `shape`, by the policy's name or a checkpoint's file. Raises ConfigError."""
    from servoid.policy.checkpoint import read_header, resolve
    from servoid.stack.control.gait import GaitPolicy
    from servoid.stack.control.tracker import ExpertPolicy

    if name == "gait":
        return partial(GaitPolicy, robot)
    if read_header(resolve(name))["kind"] == "tracker":
        return partial(ExpertPolicy, robot, name)
    from servoid.policy.diffusion.settings import load_settings
    from servoid.stack.control.diffusion import diffusion_policy
    from servoid.stack.tasks import load_task

    settings = replace(load_settings(), checkpoint=name)
    return partial(diffusion_policy, robot, settings, load_task("walk", {}, robot.dt).objective)


def mixed(a: dict[str, Array], b: dict[str, Array], seed: int) -> dict[str, Array]:
    """Worlds of two recordings in random order, so that those held out are of both."""
    order = np.random.default_rng(seed).permutation(len(a["rows"]) + len(b["rows"]))
    return {key: np.concatenate([a[key], b[key]])[order] for key in a}


def record(
    robot: Any, make: MakePolicy, worlds: int, seconds: float, seed: int, odometry: Any = None
) -> dict[str, Array]:
    """Walk randomised worlds; returns rows `(n, ticks, features)`, starts `(n, ticks)` and errors `(n, ticks, 3)`."""
    from tqdm import trange

    from servoid.stack.control.fleet import Fleet

    fleet = Fleet(robot, worlds, odometry, randomise=0.7, seed=seed + 1000)
    policy = make(shape=(fleet.n,))
    ticks = round(seconds * robot.rate)
    rows = np.zeros((worlds, ticks, fleet.estimator.features.size), np.float32)
    errors = np.zeros((worlds, ticks, 3), np.float32)
    starts = np.zeros((worlds, ticks), np.int32)
    everything = np.ones(worlds, bool)
    fleet.reset(everything)
    policy.reset(None, fleet.seeds)
    rng = np.random.default_rng(seed)
    command, start = np.zeros((worlds, 3)), np.zeros(worlds, np.int32)
    noise = rng.uniform(0.0, 0.1, (worlds, 1))
    for k in trange(ticks, desc="walking", unit="tick", mininterval=5.0):
        fleet.observe()
        rows[:, k] = fleet.estimator.features.newest
        errors[:, k] = fleet.truth.velocity - fleet.estimator.leg_velocity
        starts[:, k] = start
        due = rng.random(worlds) < 1 / 150
        command[due] = rng.uniform([-0.15, -0.13, -1.0], [0.5, 0.13, 1.0], (int(due.sum()), 3))
        command[due] *= rng.random((int(due.sum()), 3)) < 0.7
        kicked = rng.random(worlds) < 1 / 100
        angle, size = rng.uniform(-np.pi, np.pi, worlds), rng.uniform(0, 0.3, worlds) * kicked
        fleet.worlds.push(np.stack([size * np.cos(angle), size * np.sin(angle)], -1))
        target = policy.act(fleet.state, fleet.applied, Instruction(command))
        fleet.step(target, noise * rng.standard_normal(target.shape))
        fallen = fleet.truth.fallen
        if fallen.any():
            fleet.reset(fallen)
            policy.reset(fallen, fleet.seeds)
            start[fallen] = k + 1
    return {"rows": rows, "starts": starts, "errors": errors}


def fit(data: dict[str, Array], steps: int, seed: int) -> Any:
    """Fit the network on chunks of `_CHUNK` ticks; prints the error on worlds that it did not see."""
    import torch
    from torch import nn
    from tqdm import trange

    from servoid.policy.mlp import Mlp
    from servoid.stack.estimation.odometry import OFFSETS

    torch.manual_seed(seed)
    torch.set_num_threads(os.cpu_count() or 1)
    rows, errors, starts = (torch.from_numpy(data[k]) for k in ("rows", "errors", "starts"))
    worlds, ticks, _ = rows.shape
    held = max(worlds // 8, 1)
    offsets = torch.from_numpy(OFFSETS)

    def batch(first: int, last: int, size: int) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        world = torch.randint(first, last, (size, 1))
        at = torch.randint(0, ticks - _CHUNK, (size, 1)) + torch.arange(_CHUNK)
        begin = starts[world, at]
        index = torch.maximum(at[..., None] - offsets, begin[..., None])
        whole = (begin[:, :1] == begin[:, -1:]).float()  # chunks that no fall interrupts
        return rows[world[..., None], index].flatten(2), errors[world, at], whole

    sample = batch(0, worlds - held, 400)[0].flatten(0, 1)
    mean, std = sample.mean(0), sample.std(0).clamp_min(0.02)
    net = nn.Sequential(nn.Linear(sample.shape[1], 128), nn.ELU(), nn.Linear(128, 64), nn.ELU(), nn.Linear(64, 3))
    optimiser = torch.optim.AdamW(net.parameters(), 2e-3, weight_decay=1e-3)
    schedule = torch.optim.lr_scheduler.CosineAnnealingLR(optimiser, steps)

    def loss_of(x: torch.Tensor, y: torch.Tensor, whole: torch.Tensor) -> torch.Tensor:
        left = y - net((x - mean) / std)
        return (left**2).mean() + _MEAN_WEIGHT * ((left.mean(1) ** 2) * whole).mean()

    bar = trange(steps, desc="fitting", mininterval=5.0)
    for _ in bar:
        loss = loss_of(*batch(0, worlds - held, 48))
        optimiser.zero_grad()
        loss.backward()  # type: ignore[no-untyped-call]
        optimiser.step()
        schedule.step()
        bar.set_postfix(loss=f"{loss.item():.5f}")
    with torch.no_grad():
        x, y, whole = batch(worlds - held, worlds, 1000)
        left = y - net((x - mean) / std)
        for name, error in (("legs alone", y), ("corrected", left)):
            rms, slow = (error**2).mean((0, 1)).sqrt(), ((error.mean(1) ** 2) * whole).mean(0).sqrt()
            print(f"{name}: rms {rms.numpy().round(4)} m/s, of one-second means {slow.numpy().round(4)} m/s")
    dense = [m for m in net if isinstance(m, nn.Linear)]
    layers = [(m.weight.detach().numpy().T.copy(), m.bias.detach().numpy().copy()) for m in dense]
    return Mlp(layers, mean.numpy(), std.numpy())


@dataclass(frozen=True)
class Drift:
    """Displacement error as a share of the path, yaw drift in rad a minute."""

    median: float
    p90: float
    yaw_p90: float
    walks: int


def drift(
    robot: Any, make: MakePolicy, odometry: Any, *, walks: int, seconds: float, seed: int, randomise: float = 0.0
) -> Drift:
    """Walk with commands changed every 5 s and compare the estimate's end with the truth's.

    Counts walks that stayed up and covered more than a metre. The path is measured from cycle to cycle: within one, the
    gait's sway would add to it, up to its double.
    """
    from servoid.policy.references.gait import load_gait
    from servoid.stack.control.fleet import Fleet

    fleet = Fleet(robot, walks, odometry, randomise=randomise, seed=seed)
    policy = make(shape=(fleet.n,))
    everything = np.ones(walks, bool)
    fleet.reset(everything)
    policy.reset(None, fleet.seeds)
    alive, path, command = everything.copy(), np.zeros(walks), np.zeros((walks, 3))
    turned, start = np.zeros(walks), fleet.truth.position[:, :2].copy()
    last, heading, state = start, fleet.truth.yaw.copy(), fleet.observe()
    ticks, cycle = round(seconds * robot.rate), round(load_gait().cycle * robot.rate)
    for k in range(ticks):
        if k % (5 * robot.rate) == 0:
            low, high = [-0.1, -0.1, -0.8], [0.3, 0.1, 0.8]
            command = np.array([rng.uniform(low, high) for rng in fleet.rngs])
        fleet.step(policy.act(state, fleet.applied, Instruction(command)))
        state = fleet.observe()
        truth = fleet.truth
        if (k + 1) % cycle == 0 or k == ticks - 1:
            path += np.linalg.norm(truth.position[:, :2] - last, axis=-1)
            last = truth.position[:, :2].copy()
        turned += (truth.yaw - heading + np.pi) % (2 * np.pi) - np.pi
        heading = truth.yaw.copy()
        alive &= ~truth.fallen
    error = np.linalg.norm(state.displacement[:, :2] - (last - start), axis=-1)
    use = alive & (path > 1.0)
    if not use.any():
        return Drift(np.nan, np.nan, np.nan, 0)
    share, yaw = (error / path)[use], np.abs(state.yaw - turned)[use] * 60.0 / seconds
    return Drift(float(np.median(share)), float(np.quantile(share, 0.9)), float(np.quantile(yaw, 0.9)), int(use.sum()))

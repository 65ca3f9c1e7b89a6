"""Train the correction of leg odometry on walks in randomised worlds, and measure the drift that is left.

With --measure it trains nothing and measures an existing checkpoint.
"""

from __future__ import annotations

import argparse
import math
import os
import sys
from collections.abc import Callable, Iterable, Mapping, Sequence
from dataclasses import fields, replace
from functools import partial
from itertools import pairwise
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.policy import checkpoint
from servoid.policy.mlp import Mlp
from servoid.tools.learn.flags import plain, read_settings
from servoid.tools.learn.settings import OdometryTraining
from servoid.tools.learn.trainers.trainer import Trainer, add_run_arguments, option_of
from servoid.tools.learn.walks import drift, maker, mixed, record

if TYPE_CHECKING:
    import torch

    from servoid.hw.robot.description import Robot
    from servoid.tools.learn.walks import MakePolicy

SHIPPED = "odometry"
_MEASURING = ("policy", "seed", "walks", "walk_seconds")  # settings that --measure goes by


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `servoid train odometry`."""
    out = Path("runs/odometry.safetensors")
    run = add_run_arguments(parser, OdometryTraining(), out, "checkpoint to write; the folder beside it holds its run")
    run.add_argument(
        "--measure",
        nargs="?",
        const=SHIPPED,
        metavar="CHECKPOINT",
        help="train nothing, and measure this odometry (default: the shipped one) on the walks that "
        "--policy, --walks, --walk-seconds and --seed choose",
    )


def main(args: argparse.Namespace) -> int:
    """Train or measure; returns 0. Raises ConfigError."""
    os.environ.setdefault("OMP_NUM_THREADS", "1")  # the worlds use the cores
    from servoid.hw.robot.description import load_robot
    from servoid.stack.estimation.odometry import load_odometry

    settings, robot = read_settings(args, OdometryTraining()), load_robot(args.robot)
    names = ["gait", *(name for name in settings.policy if name != "gait")]
    makers = {name: maker(robot, name) for name in names}
    if args.measure is not None:
        _refuse_unused(args)
        measure(robot, makers, load_odometry(robot, args.measure), settings)
        return 0
    checkpoint.check_out(args.out, robot.names)
    trainer = OdometryTrainer(
        robot, names, partial(walked, robot, makers, settings), settings, args.out, _source(robot, names), args.threads
    )
    trainer.judge = lambda path: measure(robot, makers, load_odometry(robot, path), settings)
    trainer.start(args.resume)
    trainer.run()
    return 0


def _refuse_unused(args: argparse.Namespace) -> None:
    """Raise ConfigError for options that --measure would ignore."""
    given = [f.name for f in fields(OdometryTraining) if f.name in args and f.name not in _MEASURING]
    if given:
        flags = ", ".join("--" + name.replace("_", "-") for name in given)
        raise ConfigError(
            f"--measure trains nothing, so {flags} would be ignored: --walks and --walk-seconds set its walks"
        )


def measure(
    robot: Robot, makers: Mapping[str, MakePolicy], network: Mlp, settings: OdometryTraining
) -> dict[str, float]:
    """Print the drift of each way of walking, by legs alone and corrected; returns the 90th percentiles."""
    results = {}
    for name, make in makers.items():
        for title, odometry in (("legs alone", None), ("corrected", network)):
            walks, seconds = settings.walks, settings.walk_seconds
            print(f"{name}, {title}: {walks} walks of {seconds:g} s ...", file=sys.stderr)
            result = drift(robot, make, odometry, walks=walks, seconds=seconds, seed=settings.seed + 1)
            if not result.walks:
                print(f"{name}, {title}: no walk of {seconds:g} s stayed up and went anywhere: nothing to measure")
                continue
            key = f"drift_p90_{name}" + ("_legs_alone" if odometry is None else "")
            results[key] = round(result.p90, 4)
            print(
                f"{name}, {title}: displacement error {100 * result.median:.1f} % of the path (median), "
                f"{100 * result.p90:.1f} % (90th percentile), yaw drift {result.yaw_p90:.3f} rad a minute "
                f"(90th percentile), {result.walks} walks"
            )
    return results


def walked(robot: Robot, makers: Mapping[str, MakePolicy], settings: OdometryTraining) -> dict[str, Array]:
    """Record walks of every kind, for every way of walking slips in its own: see `record`. With a `floor` half of them
    are on a more slippery one, since feet that hold teach nothing of feet that slip, nor these of those."""
    known = _shipped(robot)
    grounds = [robot]
    if settings.floor != 1.0:
        grounds.append(replace(robot, floor_friction=settings.floor * robot.floor_friction))
    kinds = [(name, make, ground) for name, make in makers.items() for ground in grounds]
    data: dict[str, Array] = {}
    for i, (name, make, ground) in enumerate(kinds):
        worlds = settings.worlds // len(kinds)
        print(f"recording {name}: {worlds} robots, {settings.seconds:g} s ...", file=sys.stderr)
        part = record(ground, make, worlds, settings.seconds, settings.seed + i, known)
        data = mixed(data, part, settings.seed) if data else part
    return data


class OdometryTrainer(Trainer):
    """Fits the correction to walks that are recorded first, the same ones whenever the run goes on."""

    settings: OdometryTraining

    LOSS = "slow_rms"
    columns = ("loss", "learning_rate", "steps_per_s", "rms", "slow_rms", "rms_legs_alone", "slow_rms_legs_alone")
    panels = (("loss",), ("rms", "rms_legs_alone"), ("slow_rms", "slow_rms_legs_alone"))

    def __init__(
        self,
        robot: Robot,
        names: Sequence[str],
        walks: Callable[[], dict[str, Array]],
        settings: OdometryTraining,
        out: Path,
        source: str,
        threads: int = 1,
    ) -> None:
        """`walks` records those of the policies `names`. `out` is the checkpoint to write, or a folder for it."""
        named = out.suffix == ".safetensors"
        super().__init__(out.with_suffix("") if named else out, settings, source)
        self.best_path = out if named else out / "odometry.safetensors"
        self.robot, self.names, self.walks, self.threads = robot, names, walks, threads
        self._saved: Mapping[str, Any] | None = None

    @property
    def title(self) -> str:
        walks = f"{self.settings.worlds} robots, {self.settings.seconds:g} s of {', '.join(self.names)}"
        return f"odometry on the walks of {walks}"

    @property
    def following(self) -> str:
        own = Path(self.robot.folder)
        if self.best_path.resolve() == (own / "odometry.safetensors").resolve():
            return f"servoid rollout walk --policy gait{option_of(self.robot)} --episodes 10"
        return f"mkdir -p {own} && cp {self.best_path} {own / 'odometry.safetensors'}  # {self.robot.name} goes by it"

    def prepare(self) -> None:
        """Record the walks and make the network."""
        import torch
        from torch import nn

        s = self.settings
        self.tensors = {name: torch.from_numpy(value) for name, value in self.walks().items()}
        torch.manual_seed(s.seed)
        torch.set_num_threads(self.threads)
        sample = self._draw(400)[0].flatten(0, 1)
        self.mean, self.std = sample.mean(0), sample.std(0).clamp_min(0.02)
        sizes = (sample.shape[1], *s.hidden)
        hidden = [layer for a, b in pairwise(sizes) for layer in (nn.Linear(a, b), nn.ELU())]
        self.network = nn.Sequential(*hidden, nn.Linear(sizes[-1], 3))
        self.optimiser = torch.optim.AdamW(self.network.parameters(), s.learning_rate, weight_decay=s.weight_decay)
        if self._saved is not None:
            self.network.load_state_dict(self._saved["network"])
            self.optimiser.load_state_dict(self._saved["optimiser"])
            torch.set_rng_state(self._saved["generator"])

    def _draw(self, size: int, held_out: bool = False) -> tuple[torch.Tensor, torch.Tensor, torch.Tensor]:
        """Windows `(size, chunk, inputs)`, errors of the legs' velocity `(size, chunk, 3)`, and whether no fall
        interrupts a chunk `(size, 1)`. An eighth of the worlds is held out."""
        import torch

        from servoid.stack.estimation.odometry import OFFSETS

        rows, errors, starts = (self.tensors[name] for name in ("rows", "errors", "starts"))
        worlds, ticks, _ = rows.shape
        chunk, held = self.settings.chunk, max(worlds // 8, 1)
        first, last = (worlds - held, worlds) if held_out else (0, worlds - held)
        world = torch.randint(first, last, (size, 1))
        at = torch.randint(0, ticks - chunk, (size, 1)) + torch.arange(chunk)
        begin = starts[world, at]
        index = torch.maximum(at[..., None] - torch.from_numpy(OFFSETS), begin[..., None])
        whole = (begin[:, :1] == begin[:, -1:]).float()
        return rows[world[..., None], index].flatten(2), errors[world, at], whole

    def learn(self) -> dict[str, float]:
        rate = self.settings.learning_rate * 0.5 * (1.0 + math.cos(math.pi * self.share))
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        x, y, whole = self._draw(self.settings.batch)
        left = y - self.network((x - self.mean) / self.std)
        loss = (left**2).mean() + self.settings.mean_weight * ((left.mean(1) ** 2) * whole).mean()
        self.optimiser.zero_grad()
        loss.backward()
        self.optimiser.step()
        self.step += 1
        return {"loss": loss.item(), "learning_rate": rate}

    def shown(self, means: Mapping[str, float], steps_per_s: float) -> tuple[dict[str, float], str]:
        return {"steps_per_s": steps_per_s}, f"loss {means['loss']:.5f}, {steps_per_s:.0f} steps/s"

    def held_out(self) -> dict[str, float]:
        """Root mean square errors [m/s] in worlds that were held out: of each tick, and of the means of chunks."""
        import torch

        results = {}
        with torch.no_grad(), torch.random.fork_rng([]):
            torch.manual_seed(0)
            x, y, whole = self._draw(1000, held_out=True)
            left = y - self.network((x - self.mean) / self.std)
            for name, error in (("", left), ("_legs_alone", y)):
                results[f"rms{name}"] = (error**2).mean().sqrt().item()
                results[f"slow_rms{name}"] = ((error.mean(1) ** 2) * whole).mean().sqrt().item()
        return results

    def fitted(self) -> Mlp:
        """The network as it runs without torch."""
        from torch import nn

        dense = [m for m in self.network if isinstance(m, nn.Linear)]
        layers = [(m.weight.detach().numpy().T.copy(), m.bias.detach().numpy().copy()) for m in dense]
        return Mlp(layers, self.mean.numpy(), self.std.numpy())

    def ship(self, path: Path, results: Mapping[str, Any]) -> None:
        s = self.settings
        head = checkpoint.header(
            "odometry",
            self.robot,
            config={"hidden": list(s.hidden)},
            data=f"{s.worlds} randomised worlds, {s.seconds:g} s of {', '.join(self.names)}, seed {s.seed}",
            licence="Apache-2.0",
            results=results,
            training=plain(s),
        )
        self.fitted().save(path, head)

    def state(self) -> dict[str, Any]:
        import torch

        return {
            "network": self.network.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "generator": torch.get_rng_state(),
        }

    def restore(self, path: Path, saved: Mapping[str, Any]) -> None:
        """See `Trainer.restore`; the network is made when the walks are there."""
        self._saved = saved


def _source(robot: Robot, names: Iterable[str]) -> str:
    """What walks, by the hash of its network, and the odometry that it knows where it is by."""
    from servoid.stack.log.provenance import sha256

    others = [name for name in (*names, SHIPPED) if name != "gait"]
    files = {name: Path(name) if name.endswith(".safetensors") else checkpoint.resolve(name, robot) for name in others}
    hashes = {name: sha256(path) for name, path in files.items()}
    return "walks of " + ", ".join(["gait", *(f"{name} {str(value)[:12]}" for name, value in hashes.items())])


def _shipped(robot: Robot) -> Mlp | None:
    """The odometry that is there already, or None."""
    from servoid.stack.estimation.odometry import load_odometry

    try:
        return load_odometry(robot)
    except checkpoint.CheckpointError:
        return None

"""`servoid train latent`: learn latent actions, a conditional VAE with a learned prior, on a recorded dataset.

Printed and logged are what the posterior's mean loses of held-out joint targets (`reconstruction_rad`, root mean
square), what is left when the latent is taken from the prior instead (`prior_rad`), how far posterior and prior are
apart (`kl_nats`), and how the expert walks when each of its targets is encoded and decoded on its way (`survival`,
`velocity_error`), beside the expert itself. What walked best is kept.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoid.hw.config import ConfigError
from servoid.tools.learn.trainers.trainer import Survival, TimedTrainer, add_run_arguments, same

if TYPE_CHECKING:
    from servoid.hw.robot.description import Robot
    from servoid.policy.latent.actions import LatentConfig
    from servoid.policy.latent.dataset import Demonstrations

LOSSES = ("reconstruction", "kl", "change")
MEASURED = ("reconstruction_rad", "prior_rad", "kl_nats")


@dataclass(frozen=True)
class Settings:
    """How to train. Loss: squared error of normalised targets + beta KL + change of the posterior's mean, weighted."""

    minutes: float = 5.0
    steps: int = 0  # 0: as many as fit into the minutes
    batch: int = 512  # pairs of ticks
    learning_rate: float = 1e-3
    beta: tuple[float, float] = (0.01, 0.001)  # at the beginning and at the end, as PULSE's; geometric in between
    change: float = 0.005  # PULSE's weight of the change of latents from a tick to the next
    evaluate_every: float = 1.0
    seed: int = 0

    def __post_init__(self) -> None:
        if min(self.beta) <= 0 or self.change < 0:
            raise ConfigError("beta must be positive, and the weight of changes not negative")
        if self.batch < 1 or self.learning_rate <= 0:
            raise ConfigError("batch and learning rate must be positive")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `servoid train latent`."""
    d = Settings()
    add_run_arguments(parser, d.minutes, d.evaluate_every, "reconstruction")
    parser.add_argument("--size", type=int, default=16, help="numbers of a latent")
    parser.add_argument("--width", type=int, default=256, help="of hidden layers")
    parser.add_argument("--layers", type=int, default=2, help="hidden ones")
    parser.add_argument("--batch", type=int, default=d.batch, help="pairs of ticks")
    parser.add_argument("--learning-rate", type=float, default=d.learning_rate)
    parser.add_argument(
        "--beta", type=float, nargs=2, default=d.beta, metavar=("FIRST", "LAST"), help="weight of the KL divergence"
    )
    parser.add_argument("--change", type=float, default=d.change, help="weight of the change of latents over a tick")


def main(args: argparse.Namespace) -> int:
    """Train; returns 0 when the budget is used up. Raises ConfigError."""
    os.environ.setdefault(
        "OMP_WAIT_POLICY", "passive"
    )  # read when torch is loaded; see `servoid.tools.learn.trainers.diffusion`
    import torch

    from servoid.hw.robot.description import load_robot
    from servoid.policy.diffusion.dataset import read_recording
    from servoid.policy.latent.actions import LatentConfig
    from servoid.policy.latent.dataset import Demonstrations

    torch.set_num_threads(args.threads)
    robot = load_robot(args.robot)
    config = LatentConfig(args.size, args.width, args.layers)
    names = ("minutes", "steps", "batch", "learning_rate", "change", "evaluate_every", "seed")
    settings = Settings(beta=(args.beta[0], args.beta[1]), **{name: getattr(args, name) for name in names})
    recording = read_recording(args.data, robot)
    source = f"{args.data.resolve().name}: {len(recording.spans)} episodes, {len(recording.raw)} ticks"
    survival = _survival(robot, args) if args.survival_worlds else None
    pairs = Demonstrations(recording, robot)
    trainer = LatentTrainer(pairs, robot, config, settings, args.out, source, args.licence, survival)
    if args.resume:
        trainer.resume()
    trainer.run()
    return 0


def _survival(robot: Robot, args: argparse.Namespace) -> Survival:
    """The closed-loop measurement, the expert's own beside it, which is taken here. Raises ConfigError."""
    from servoid.policy.latent.actions import load_latents
    from servoid.tools.learn.latent_roundtrip import recoded_survival

    world = (args.survival_seconds, args.survival_worlds, args.seed)
    expert = {f"expert_{name}": value for name, value in recoded_survival(robot, None, *world).items()}
    print(", ".join(f"{name} {value:.4g}" for name, value in expert.items()), file=sys.stderr)

    def measure(path: Path) -> Mapping[str, float]:
        return recoded_survival(robot, load_latents(path, robot), *world) | expert

    return measure


class LatentTrainer(TimedTrainer):
    """Trains the VAE; `latent.safetensors` is the one through which the expert walks best."""

    settings: Settings

    BEST = "latent.safetensors"
    LOSS = "reconstruction_rad"
    COLUMNS = ("minutes", *LOSSES, "beta", "steps_per_s", *MEASURED, "survival", "velocity_error")
    PANELS = (("reconstruction_rad", "prior_rad"), ("kl_nats", "kl"), ("survival",), ("velocity_error",))

    def __init__(
        self,
        pairs: Demonstrations,
        robot: Robot,
        config: LatentConfig,
        settings: Settings,
        out: Path,
        source: str,
        licence: str,
        survival: Survival | None,
    ) -> None:
        import torch

        from servoid.policy.latent.network import LatentNetwork

        super().__init__(out, settings, survival)
        torch.manual_seed(settings.seed)
        self.pairs, self.robot, self.config = pairs, robot, config
        self.source, self.licence = source, licence
        self.network = LatentNetwork(config, pairs.states, pairs.actions)
        self.optimiser = torch.optim.Adam(self.network.parameters(), settings.learning_rate)
        self.generator = torch.Generator().manual_seed(settings.seed)

    def _title(self) -> str:
        count = sum(p.numel() for p in self.network.parameters())
        return f"latents of {self.config.size}, {count:,} parameters, on {len(self.pairs.training):,} ticks"

    @property
    def beta(self) -> float:
        """Weight of the KL divergence now."""
        first, last = self.settings.beta
        return float(first * (last / first) ** self.share)

    def _step(self) -> tuple[float, ...]:
        import torch

        for group in self.optimiser.param_groups:
            group["lr"] = self.settings.learning_rate * (1.0 - 0.95 * self.share)
        terms = self.network.terms(*self.pairs.draw(self.settings.batch, self.generator), self.generator)
        loss = terms.reconstruction + self.beta * terms.kl + self.settings.change * terms.change
        if not torch.isfinite(loss):
            raise ConfigError(f"the loss is not finite at step {self.step}: try a lower --learning-rate")
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        self.step += 1
        return terms.reconstruction.item(), terms.kl.item(), terms.change.item()

    def _progress(self, losses: tuple[float, ...], steps_per_s: float) -> tuple[dict[str, float], str]:
        columns = dict(zip(LOSSES, losses, strict=True)) | {"beta": self.beta, "steps_per_s": steps_per_s}
        text = f"reconstruction {losses[0]:.4f}, KL {losses[1]:.2f} nats, beta {self.beta:.4f}"
        return columns, f"{text}, {steps_per_s:.0f} steps/s"

    def _held_out(self, count: int = 8192) -> dict[str, float]:
        import numpy as np
        import torch

        rows, targets = self.pairs.held_out(count)
        latents = self.network.to_numpy()
        raw, wanted = rows.numpy(), targets.numpy()
        decoded = latents.decode(raw, latents.encode(raw, wanted)), latents.decode(raw, latents.expected(raw))
        losses = [float(np.sqrt(np.square(found - wanted).mean())) for found in decoded]
        with torch.no_grad():
            kl = self.network.terms(rows, targets).kl.item()
        return dict(zip(MEASURED, (*losses, kl), strict=True))

    def _ship(self, path: Path, results: Mapping[str, float]) -> None:
        from servoid.policy.latent.actions import save_latents

        facts = {**self.progress, **results}
        latents, how = self.network.to_numpy(), {**asdict(self.settings), "beta": list(self.settings.beta)}
        save_latents(path, latents, self.robot, data=self.source, licence=self.licence, results=facts, training=how)

    def _state(self) -> dict[str, Any]:
        return {
            "config": asdict(self.config),
            "network": self.network.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "generator": self.generator.get_state(),
            "normalisation": [self.pairs.states.mean, self.pairs.actions.mean],
        }

    def _restore(self, path: Path, saved: Mapping[str, Any]) -> None:
        import torch

        same(path, "another network", asdict(self.config), saved["config"])
        ours = self.pairs.states.mean, self.pairs.actions.mean
        if not all(torch.equal(a, b) for a, b in zip(ours, saved["normalisation"], strict=True)):
            raise ConfigError(f"{path}: trained on other data; use --no-resume or another --out")
        self.network.load_state_dict(saved["network"])
        self.optimiser.load_state_dict(saved["optimiser"])
        self.generator.set_state(saved["generator"])

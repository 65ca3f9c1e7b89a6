"""Train latent actions, a conditional VAE with a learned prior, on a recorded dataset.

It measures the error of held-out joint targets that the posterior's mean reconstructs (`reconstruction_rad`, root mean
square) and that the prior's mean gives (`prior_rad`), how far posterior and prior are apart (`kl_nats`), and how the
expert walks when each of its targets is encoded and decoded (`survival`, `velocity_error`), beside the expert itself.
The latents through which it walks best are kept.
"""

from __future__ import annotations

import argparse
import os
import sys
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoid.hw.config import ConfigError
from servoid.tools.learn.flags import plain, read_settings
from servoid.tools.learn.settings import LatentTraining
from servoid.tools.learn.trainers.trainer import Judge, Trainer, add_run_arguments

if TYPE_CHECKING:
    from servoid.hw.robot.description import Robot
    from servoid.policy.latent.dataset import Demonstrations

LOSSES = ("reconstruction", "kl", "change")
MEASURED = ("reconstruction_rad", "prior_rad", "kl_nats")


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `servoid train latent`."""
    add_run_arguments(parser, LatentTraining(), data=True)


def main(args: argparse.Namespace) -> int:
    """Train; returns 0 when the budget is used up. Raises ConfigError."""
    # Threads that spin while they wait for each other make a step ten times slower when another program is running.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # read when torch is loaded
    import torch

    from servoid.hw.robot.description import load_robot
    from servoid.policy.latent.dataset import Demonstrations
    from servoid.policy.recording import read_recording, source_of

    settings = read_settings(args, LatentTraining())
    torch.set_num_threads(args.threads)
    robot = load_robot(args.robot)
    recording = read_recording(args.data, robot)
    judge = _judge(robot, settings) if settings.survival_worlds else None
    pairs = Demonstrations(recording, robot)
    trainer = LatentTrainer(pairs, robot, settings, args.out, source_of(args.data, recording), judge)
    trainer.data = str(args.data)
    trainer.start(args.resume)
    trainer.run()
    return 0


def _judge(robot: Robot, settings: LatentTraining) -> Judge:
    """The closed-loop measurement, the expert's own beside it, which is taken here. Raises ConfigError."""
    from servoid.policy.latent.actions import load_latents
    from servoid.tools.learn.latent_roundtrip import recoded_survival

    world = (settings.survival_seconds, settings.survival_worlds, settings.seed)
    print("measuring the expert itself ...", file=sys.stderr)
    expert = {f"expert_{name}": value for name, value in recoded_survival(robot, None, *world).items()}
    print(", ".join(f"{name} {value:.4g}" for name, value in expert.items()), file=sys.stderr)

    def measure(path: Path) -> Mapping[str, float]:
        return recoded_survival(robot, load_latents(path, robot), *world) | expert

    return measure


class LatentTrainer(Trainer):
    """Trains the VAE; `latent.safetensors` is the one through which the expert walks best."""

    settings: LatentTraining
    data: str = "DATA"  # the dataset's folder, as it was typed

    BEST = "latent.safetensors"
    LOSS = "reconstruction_rad"
    columns = (*LOSSES, "beta", "steps_per_s", *MEASURED, "survival", "velocity_error")
    panels = (("reconstruction_rad", "prior_rad"), ("kl_nats", "kl"), ("survival",), ("velocity_error",))

    def __init__(
        self,
        pairs: Demonstrations,
        robot: Robot,
        settings: LatentTraining,
        out: Path,
        source: str,
        judge: Judge | None,
    ) -> None:
        import torch

        from servoid.policy.latent.network import LatentNetwork

        super().__init__(out, settings, source, judge)
        torch.manual_seed(settings.seed)
        self.pairs, self.robot = pairs, robot
        self.network = LatentNetwork(settings, pairs.states, pairs.actions)
        self.optimiser = torch.optim.Adam(self.network.parameters(), settings.learning_rate)
        self.generator = torch.Generator().manual_seed(settings.seed)

    @property
    def title(self) -> str:
        count = sum(p.numel() for p in self.network.parameters())
        return f"latents of {self.settings.size}, {count:,} parameters, on {len(self.pairs.training):,} ticks"

    @property
    def following(self) -> str:
        return f"servoid train diffusion --data {self.data} --out runs/latent-walks --latent {self.best_path}"

    @property
    def beta(self) -> float:
        """Weight of the KL divergence now."""
        first, last = self.settings.beta
        return float(first * (last / first) ** self.share)

    def learn(self) -> dict[str, float]:
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
        return {name: getattr(terms, name).item() for name in LOSSES}

    def shown(self, means: Mapping[str, float], steps_per_s: float) -> tuple[dict[str, float], str]:
        text = f"reconstruction {means['reconstruction']:.4f}, KL {means['kl']:.2f} nats, beta {self.beta:.4f}"
        return {"beta": self.beta, "steps_per_s": steps_per_s}, f"{text}, {steps_per_s:.0f} steps/s"

    def held_out(self, count: int = 8192) -> dict[str, float]:
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

    def ship(self, path: Path, results: Mapping[str, Any]) -> None:
        from servoid.policy.checkpoint import Origin
        from servoid.policy.latent.actions import save_latents

        origin = Origin(self.source, self.settings.licence, results, plain(self.settings))
        save_latents(path, self.network.to_numpy(), self.robot, origin)

    def state(self) -> dict[str, Any]:
        return {
            "network": self.network.state_dict(),
            "optimiser": self.optimiser.state_dict(),
            "generator": self.generator.get_state(),
            "normalisation": [self.pairs.states.mean, self.pairs.actions.mean],
        }

    def restore(self, path: Path, saved: Mapping[str, Any]) -> None:
        import torch

        ours = self.pairs.states.mean, self.pairs.actions.mean
        if not all(torch.equal(a, b) for a, b in zip(ours, saved["normalisation"], strict=True)):
            raise ConfigError(f"{path}: trained on other data; use --no-resume or another --out")
        self.network.load_state_dict(saved["network"])
        self.optimiser.load_state_dict(saved["optimiser"])
        self.generator.set_state(saved["generator"])

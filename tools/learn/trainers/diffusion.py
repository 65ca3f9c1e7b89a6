"""Train the diffusion model, which plans and controls, on a recorded dataset.

Ctrl-C saves, and the same command continues.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Mapping, Sequence
from dataclasses import asdict, fields
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.policy.checkpoint import Origin
from servoid.policy.diffusion.model.config import DenoiserConfig, DenoiserShape, TrainingObjective
from servoid.policy.features import token_layout
from servoid.policy.text.encoder import load_encoder
from servoid.tools.learn.flags import plain, read_settings
from servoid.tools.learn.settings import DiffusionTraining
from servoid.tools.learn.trainers.trainer import (
    Judge,
    Trainer,
    add_run_arguments,
    option_of,
    require_same,
)

if TYPE_CHECKING:
    import torch

    from servoid.hw.robot.description import Robot
    from servoid.policy.diffusion.dataset import Windows
    from servoid.policy.diffusion.model.config import DenoiserConfig


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `servoid train diffusion`."""
    run = add_run_arguments(parser, DiffusionTraining(), data=True)
    run.add_argument(
        "--init", type=Path, metavar="CHECKPOINT", help="start from this diffusion model, with its normalisation"
    )
    run.add_argument(
        "--distil",
        type=Path,
        metavar="CHECKPOINT",
        help="start from this diffusion model and learn to take in one step what it takes in two (docs/diffusion.md)",
    )
    run.add_argument(
        "--latent",
        type=Path,
        metavar="CHECKPOINT",
        help="plan in the latents of this file (`servoid train latent`) instead of joint targets",
    )


def main(args: argparse.Namespace) -> int:
    """Train; returns 0 when the budget is used up. Raises ConfigError."""
    # Threads that spin while they wait for each other make a step ten times slower when another program is running.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # read when torch is loaded
    import torch

    from servoid.hw.robot.description import load_robot
    from servoid.policy.diffusion.dataset import Windows
    from servoid.policy.latent.actions import load_latents
    from servoid.policy.recording import read_recording, source_of
    from servoid.tools.learn.collect.told import skills_in, told_of

    # What cannot be trained or measured is refused before the data is read.
    settings = read_settings(args, DiffusionTraining())
    judge = _judge(settings, args.robot) if settings.survival_worlds else None
    if settings.clock and not settings.text:
        raise ConfigError("--clock says how long what is told has lasted: it goes with --text words")
    torch.set_num_threads(args.threads)
    robot = load_robot(args.robot)
    latents = load_latents(args.latent, robot) if args.latent else None
    config = denoiser_config(settings, len(robot.joints), latents.size if latents else None)
    if judge is not None:
        from servoid.tools.learn.survival import planning

        planning(config, asdict(settings))
    recording = read_recording(args.data, robot)
    skills = skills_in(recording, robot)
    if bool(skills) != bool(settings.clock):
        raise ConfigError(
            f"{args.data}: shows skills, which take --config skills: a clock says how far they are"
            if skills
            else f"{args.data}: shows no skills, and --clock is for those: record some with `servoid collect --skills`"
        )
    told = told_of(recording, robot, skills)
    windows = Windows(recording, robot, config, told, settings.emphasis, settings.seed, latents)
    trainer = DiffusionTrainer(windows, robot, settings, args.out, source_of(args.data, recording), judge)
    trainer.skills = {name: skill.phrases for name, skill in skills.items()}
    if args.distil is not None:
        trainer.teach(args.distil)
    trainer.start(args.resume, args.init or args.distil)
    trainer.run()
    return 0


def denoiser_config(settings: DiffusionTraining, n_joints: int, latent_size: int | None = None) -> DenoiserConfig:
    """The network that `settings` ask for, with actions in joint targets, or in latents of that size.

    Raises ConfigError.
    """
    return DenoiserConfig(
        token_layout(n_joints).size * (2 if settings.emphasis else 1),
        latent_size or n_joints,
        settings.text,
        load_encoder(settings.text).size + 2 * settings.clock if settings.text else 0,
        **{f.name: getattr(settings, f.name) for f in fields(DenoiserShape)},
    )


def _judge(settings: DiffusionTraining, robot: str) -> Judge:
    """The closed-loop measurement, looked for before training starts. Raises ConfigError."""
    try:
        measure = import_module("servoid.tools.learn.survival").closed_loop_survival
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"closed-loop survival cannot be measured ({error}); "
            "--survival-worlds 0 keeps the best checkpoint by validation loss instead"
        ) from error
    if settings.clock:
        measure = import_module("servoid.tools.learn.following").sentences_followed
    seconds, worlds = settings.survival_seconds, settings.survival_worlds
    return partial(measure, seconds=seconds, worlds=worlds, seed=settings.seed, robot_name=robot)


class DiffusionTrainer(Trainer):
    """Trains a denoiser; checkpoints hold the averaged network."""

    settings: DiffusionTraining

    LOSS = "validation_action_loss"
    columns: Sequence[str] = (
        "loss",
        "state_loss",
        "action_loss",
        "learning_rate",
        "tokens_per_s",
        LOSS,
        "survival",
        "velocity_error",
    )
    panels: Sequence[Sequence[str]] = (("state_loss", "action_loss", LOSS), ("survival",), ("velocity_error",))

    def __init__(
        self,
        windows: Windows,
        robot: Robot,
        settings: DiffusionTraining,
        out: Path,
        source: str,
        judge: Judge | None,
    ) -> None:
        import torch

        from servoid.policy.diffusion.model.denoiser import Denoiser
        from servoid.policy.diffusion.objective import Average
        from servoid.policy.diffusion.schedule import cosine_signal

        super().__init__(out, settings, source, judge)
        torch.manual_seed(settings.seed)
        self.windows, self.robot, self.config = windows, robot, windows.config
        self.skills: Mapping[str, tuple[str, ...]] = {}  # that are learned, with their phrasings
        if self.config.clock:
            shares = ("followed", "followed_walks", "followed_skills")
            self.columns, self.panels = (*self.columns[:-1], *shares), (*self.panels[:-1], shares)
        self.network = Denoiser(self.config)
        self.teacher: Denoiser | None = None  # where there is one, its steps are learned
        self.average = Average(self.network, settings.average)
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), settings.learning_rate, betas=(0.9, 0.99), weight_decay=settings.weight_decay
        )
        self.signal = torch.as_tensor(cosine_signal(self.config.levels), dtype=torch.float32)
        self.generator = torch.Generator().manual_seed(settings.seed)

    def adopt(self, path: Path) -> None:
        """Take weights and normalisation of a checkpoint, to go on with other data; of one of another shape, the
        weights alone, converted. Raises ConfigError."""
        from servoid.policy.diffusion.model.checkpoint import load
        from servoid.policy.diffusion.model.converted import converted
        from servoid.policy.latent.actions import same_latents

        model = load(path, self.robot)
        if not same_latents(model.latents, self.windows.latents):
            raise ConfigError(f"{path}: its actions are not those of --latent: use the same latents, or none")
        windows = self.windows
        try:
            weights = (
                converted(model, self.config, windows.states, windows.actions)
                if model.config != self.config
                else model.denoiser.state_dict()
            )
        except ConfigError as error:
            raise ConfigError(f"{path}: {error}") from None
        self.network.load_state_dict(weights)
        self.average.weights = {name: p.detach().clone() for name, p in self.network.named_parameters()}
        if model.config == self.config:
            windows.states, windows.actions = model.states, model.actions

    def teach(self, path: Path) -> None:
        """Learn from a diffusion model instead of from the windows alone. Raises ConfigError where it is of another
        shape."""
        from servoid.policy.diffusion.model.checkpoint import load

        model = load(path, self.robot)
        if model.config != self.config:
            raise ConfigError(f"{path}: --distil takes a model of the same shape: give the settings of its training")
        self.teacher = model.denoiser

    @property
    def title(self) -> str:
        size = f"{self.network.parameter_count:,} parameters, {self.config.tokens} tokens"
        actions = "latent actions" if self.windows.latents else "joint targets"
        return f"{size} on {len(self.windows.training):,} windows with {actions}"

    @property
    def following(self) -> str:
        return f"servoid rollout walk --policy {self.best_path}{option_of(self.robot)} --episodes 50"

    def learn(self) -> dict[str, float]:
        import torch

        from servoid.policy.diffusion.distillation import distilled_losses
        from servoid.policy.diffusion.objective import losses

        settings = self.settings
        warm = min(1.0, (self.step + 1) / settings.warmup_steps)
        rate = settings.learning_rate * warm * (0.5 + 0.5 * math.cos(math.pi * self.share))
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        window = self.windows.draw(settings.batch, self.generator)
        given = self.signal, self.generator, settings
        with torch.autocast("cpu", torch.bfloat16, enabled=settings.precision == "bf16"):
            parts = (
                losses(self.network, *window, *given)
                if self.teacher is None
                else distilled_losses(self.network, self.teacher, window, *given, settings.distil_steps)
            )
        total = parts[0] + parts[1]
        if not torch.isfinite(total):
            raise ConfigError(f"the loss is not finite at step {self.step}: try a lower --learning-rate, or fp32")
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        self.average.update(self.network)
        self.step += 1
        state_loss, action_loss = parts[0].item(), parts[1].item()
        return {
            "loss": state_loss + action_loss,
            "state_loss": state_loss,
            "action_loss": action_loss,
            "learning_rate": rate,
        }

    def shown(self, means: Mapping[str, float], steps_per_s: float) -> tuple[dict[str, float], str]:
        speed = steps_per_s * self.settings.batch * self.config.tokens
        text = f"states {means['state_loss']:.3f}, actions {means['action_loss']:.3f}, {1000 / steps_per_s:.0f} ms/step"
        return {"tokens_per_s": speed}, f"{text}, {speed:,.0f} tokens/s"

    def score(self, results: Mapping[str, float]) -> tuple[float, float]:
        """By the sentences that it follows, where it is told such, or by survival."""
        return (results["followed"], 0.0) if "followed" in results else super().score(results)

    def held_out(self) -> dict[str, float]:
        return {self.LOSS: self.validation_loss()}

    def validation_loss(self, count: int = 1024) -> float:
        """Action loss of the averaged network on held-out windows, the same noise every time."""
        import torch

        from servoid.policy.diffusion.model.denoiser import Denoiser
        from servoid.policy.diffusion.objective import losses

        network = Denoiser(self.config).eval()
        network.load_state_dict(self.average.weights)
        states, actions, text = self.windows.held_out(count)
        # The same measure whatever else is trained for, so that runs can be compared.
        same = self.settings
        measure = TrainingObjective(same.inference_delay, same.near_actions, same.far_actions, monotone=0.0)
        with torch.inference_mode():
            given = states, actions, text, self.signal, torch.Generator().manual_seed(0)
            return losses(network, *given, measure)[1].item()

    def ship(self, path: Path, results: Mapping[str, Any]) -> None:
        from servoid.policy.diffusion.model.checkpoint import Trained, save

        windows = self.windows
        trained = Trained(
            self.average.weights, self.config, windows.states, windows.actions, windows.latents, self.skills
        )
        save(path, trained, self.robot, Origin(self.source, self.settings.licence, results, plain(self.settings)))

    def state(self) -> dict[str, Any]:
        return {
            "config": asdict(self.config),
            "network": self.network.state_dict(),
            "average": self.average.weights,
            "updates": self.average.updates,
            "optimiser": self.optimiser.state_dict(),
            "generator": self.generator.get_state(),
            "latents": _tensors(self.windows.latents.to_tensors() if self.windows.latents else {}),
            # Whole, with the matrix of the emphasis: another seed or --init may have made them.
            "states": _tensors(self.windows.states.to_numpy()),
            "actions": _tensors(self.windows.actions.to_numpy()),
        }

    def restore(self, path: Path, saved: Mapping[str, Any]) -> None:
        from servoid.policy.features import Normaliser

        latents = _arrays(saved["latents"])
        ours = self.windows.latents.to_tensors() if self.windows.latents else {}
        if ours.keys() != latents.keys() or any((ours[name] != latents[name]).any() for name in ours):
            raise ConfigError(f"{path}: trained with other latents; use --no-resume or another --out")
        require_same(path, "another network", asdict(self.config), {"ticks": (), "clock": 0} | saved["config"])
        self.windows.states, self.windows.actions = (
            Normaliser.from_numpy(_arrays(saved[name])).to_torch() for name in ("states", "actions")
        )
        self.network.load_state_dict(saved["network"])
        self.average.weights = saved["average"]
        self.average.updates = saved["updates"]
        self.optimiser.load_state_dict(saved["optimiser"])
        self.generator.set_state(saved["generator"])


def _tensors(arrays: Mapping[str, Array]) -> dict[str, torch.Tensor]:
    """Arrays as `torch.load` takes them back without pickle."""
    import torch

    return {name: torch.from_numpy(np.array(value)) for name, value in arrays.items()}


def _arrays(tensors: Mapping[str, torch.Tensor]) -> dict[str, Array]:
    return {name: value.numpy() for name, value in tensors.items()}

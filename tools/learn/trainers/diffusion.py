"""`servoid train diffusion`: train the diffusion planner-controller on a recorded dataset."""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Mapping
from dataclasses import asdict, dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.tools.learn.trainers.trainer import Survival, TimedTrainer, add_run_arguments, same

if TYPE_CHECKING:
    import torch

    from servoid.hw.robot.description import Robot
    from servoid.policy.diffusion.dataset import Windows
    from servoid.policy.diffusion.model.config import DenoiserConfig

MEANS = ("loss", "state_loss", "action_loss", "learning_rate", "tokens_per_s")
OBJECTIVE = ("near_actions", "far_actions", "min_snr", "action_rate", "monotone", "forcing")


@dataclass(frozen=True)
class Settings:
    """How to train; times in minutes of training, evaluations not counted."""

    minutes: float = 45.0
    steps: int = 0  # 0: as many as fit into the minutes
    batch: int = 128
    learning_rate: float = 6e-4
    weight_decay: float = 1e-3
    warmup_steps: int = 200
    committed: int = 2  # actions to come that may be given, because they run while a plan is made
    average: float = 0.999
    evaluate_every: float = 5.0
    seed: int = 0
    precision: str = "bf16"
    near_actions: int = 8  # this and the rest: see `servoid.policy.diffusion.objective.Objective`
    far_actions: float = 0.2
    min_snr: float = 0.0
    action_rate: float = 0.0
    monotone: float = 0.25
    forcing: float = 0.25


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `servoid train diffusion`."""
    d = Settings()
    add_run_arguments(parser, d.minutes, d.evaluate_every, "validation loss")
    parser.add_argument("--init", type=Path, help="checkpoint to begin from; its normalisation is kept")
    parser.add_argument(
        "--latent", type=Path, help="plan latents of this file (`servoid train latent`), not joint targets"
    )
    parser.add_argument("--batch", type=int, default=d.batch)
    parser.add_argument("--learning-rate", type=float, default=d.learning_rate)
    parser.add_argument("--layers", type=int, default=2)
    parser.add_argument("--width", type=int, default=192)
    parser.add_argument("--heads", type=int, default=4)
    parser.add_argument("--history", type=int, default=4, help="past and present states (ticks)")
    parser.add_argument("--horizon", type=int, default=16, help="ticks to come")
    parser.add_argument("--actions", type=int, default=0, help="ticks to come with actions; 0: all of --horizon")
    parser.add_argument("--levels", type=int, default=20, help="noise levels")
    parser.add_argument("--text", default="words", help="encoder of instructions; empty: a model that takes none")
    parser.add_argument("--emphasis", type=float, default=5.0, help="of global states; 0: no projection")
    parser.add_argument("--mask", default="state_full_action_causal", help="attention mask")
    parser.add_argument("--committed", type=int, default=d.committed, help="longest delay, in ticks, to be trained for")
    parser.add_argument("--near-actions", type=int, default=d.near_actions, help="ticks whose actions count in full")
    parser.add_argument("--far-actions", type=float, default=d.far_actions, help="weight of later ones; 0: none")
    parser.add_argument("--min-snr", type=float, default=d.min_snr, help="clip of SNR loss weights, 5 for one; 0: none")
    parser.add_argument("--action-rate", type=float, default=d.action_rate, help="weight of the error of changes")
    parser.add_argument(
        "--monotone",
        type=float,
        default=d.monotone,
        help="share of windows with rising noise levels, at most two thirds of what --forcing leaves",
    )
    parser.add_argument(
        "--forcing",
        type=float,
        default=d.forcing,
        help="share of windows with independent noise levels, past included: Diffusion Forcing (1: with --monotone 0)",
    )
    parser.add_argument("--precision", choices=("bf16", "fp32"), default=d.precision)


def main(args: argparse.Namespace) -> int:
    """Train; returns 0 when the budget is used up. Raises ConfigError."""
    # Threads that spin while they wait for each other make a step ten times slower when another program is running.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # read when torch is loaded
    import torch

    from servoid.hw.robot.description import load_robot
    from servoid.policy.diffusion.dataset import Windows, read_recording
    from servoid.policy.diffusion.features import token_layout
    from servoid.policy.diffusion.model.config import DenoiserConfig
    from servoid.policy.diffusion.objective import Objective
    from servoid.policy.latent.actions import load_latents
    from servoid.policy.text.encoder import load_encoder

    if args.history < 2:
        raise ConfigError(f"--history {args.history}: at least 2 is needed, for what ran last is an action of the past")
    survival = _survival(args) if args.survival_worlds else None
    torch.set_num_threads(args.threads)
    robot = load_robot(args.robot)
    shape = ("layers", "width", "heads", "history", "horizon", "actions", "levels", "mask", "text")
    n = len(robot.joints)
    latents = load_latents(args.latent, robot) if args.latent else None
    config = DenoiserConfig(
        token_layout(n).size * (2 if args.emphasis else 1),
        latents.size if latents else n,
        text_size=load_encoder(args.text).size if args.text else 0,
        **{name: getattr(args, name) for name in shape},
    )
    names = "minutes", "steps", "batch", "learning_rate", "committed", "evaluate_every", "seed", "precision"
    settings = Settings(**{name: getattr(args, name) for name in (*names, *OBJECTIVE)})
    # What cannot be trained or measured is refused before the data is read.
    Objective(**{name: getattr(settings, name) for name in OBJECTIVE})
    if not 0 <= settings.committed <= config.horizon:
        raise ConfigError(f"--committed {settings.committed}: 0 to the horizon of {config.horizon} ticks is needed")
    if survival is not None:
        from servoid.tools.learn.survival import planning

        planning(config, asdict(settings))
    recording = read_recording(args.data, robot)
    windows = Windows(recording, robot, config, emphasis=args.emphasis, seed=args.seed, latents=latents)
    source = f"{args.data.resolve().name}: {len(recording.spans)} episodes, {len(recording.raw)} ticks"
    trainer = Trainer(windows, robot, config, settings, args.out, source, args.licence, survival)
    if args.resume and trainer.resume():
        trainer.require_begun_with(args.init)
    elif args.init is not None:
        trainer.begin_from(args.init)
    trainer.run()
    return 0


def _survival(args: argparse.Namespace) -> Survival:
    """The closed-loop measurement, looked for before training starts. Raises ConfigError."""
    try:
        measure = import_module("servoid.tools.learn.survival").closed_loop_survival
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"closed-loop survival cannot be measured ({error}); "
            "--survival-worlds 0 keeps the best checkpoint by validation loss instead"
        ) from error
    seconds, worlds = args.survival_seconds, args.survival_worlds
    return partial(measure, seconds=seconds, worlds=worlds, seed=args.seed, robot_name=args.robot)


class Trainer(TimedTrainer):
    """Trains a denoiser; checkpoints hold the averaged network."""

    settings: Settings

    LOSS = "validation_action_loss"
    COLUMNS = ("minutes", *MEANS, LOSS, "survival", "velocity_error")
    PANELS = (("state_loss", "action_loss", LOSS), ("survival",), ("velocity_error",))

    def __init__(
        self,
        windows: Windows,
        robot: Robot,
        config: DenoiserConfig,
        settings: Settings,
        out: Path,
        source: str,
        licence: str,
        survival: Survival | None,
    ) -> None:
        import torch

        from servoid.policy.diffusion.model.denoiser import Denoiser
        from servoid.policy.diffusion.objective import Average, Objective
        from servoid.policy.diffusion.schedule import cosine_signal

        super().__init__(out, settings, survival)
        self.objective = Objective(**{name: getattr(settings, name) for name in OBJECTIVE})
        torch.manual_seed(settings.seed)
        self.windows, self.robot, self.config = windows, robot, config
        self.source, self.licence = source, licence
        self.begun_with: dict[str, Any] = {}  # the checkpoint that training began with, if any
        self.network = Denoiser(config)
        self.average = Average(self.network, settings.average)
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), settings.learning_rate, betas=(0.9, 0.99), weight_decay=settings.weight_decay
        )
        self.signal = torch.as_tensor(cosine_signal(config.levels), dtype=torch.float32)
        self.generator = torch.Generator().manual_seed(settings.seed)

    def begin_from(self, path: Path) -> None:
        """Take weights and normalisation of a checkpoint, to go on with other data. Raises ConfigError."""
        from servoid.policy.diffusion.model.checkpoint import load
        from servoid.policy.latent.actions import same_latents
        from servoid.stack.log.provenance import sha256

        model = load(path, self.robot)
        if model.config != self.config:
            raise ConfigError(f"{path}: another network than the options ask for: {model.config}")
        if not same_latents(model.latents, self.windows.latents):
            raise ConfigError(f"{path}: its actions are not those that --latent gives: use the same latents, or none")
        self.network.load_state_dict(model.denoiser.state_dict())
        self.average.weights = {name: p.detach().clone() for name, p in self.network.named_parameters()}
        self.windows.states, self.windows.actions = model.states, model.actions
        known = {name: model.header[name] for name in ("git_commit", "data", "licence", "results")}
        self.begun_with = {"checkpoint": path.name, "sha256": sha256(path), **known}

    def require_begun_with(self, path: Path | None) -> None:
        """Raise ConfigError where a resumed run began otherwise than with the checkpoint `path`, as far as is known."""
        from servoid.stack.log.provenance import sha256

        if path is not None and self.begun_with and self.begun_with["sha256"] != sha256(path):
            raise ConfigError(
                f"{self.out}: holds a run that did not begin with {path}: give --no-resume, or another --out"
            )

    def _title(self) -> str:
        size = f"{self.network.parameter_count:,} parameters, {self.config.tokens} tokens"
        actions = "latent actions" if self.windows.latents else "joint targets"
        return f"{size} on {len(self.windows.training):,} windows with {actions}"

    def _progress(self, losses: tuple[float, ...], steps_per_s: float) -> tuple[dict[str, float], str]:
        state_loss, action_loss = losses
        speed = steps_per_s * self.settings.batch * self.config.tokens
        columns = {
            "loss": state_loss + action_loss,
            "state_loss": state_loss,
            "action_loss": action_loss,
            "learning_rate": self.optimiser.param_groups[0]["lr"],
            "tokens_per_s": speed,
        }
        text = f"states {state_loss:.3f}, actions {action_loss:.3f}, {1000 / steps_per_s:.0f} ms/step"
        return columns, f"{text}, {speed:,.0f} tokens/s"

    def _step(self) -> tuple[float, float]:
        import torch

        from servoid.policy.diffusion.objective import losses

        settings = self.settings
        warm = min(1.0, (self.step + 1) / settings.warmup_steps)
        rate = settings.learning_rate * warm * (0.5 + 0.5 * math.cos(math.pi * self.share))
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        states, actions, text = self.windows.draw(settings.batch, self.generator)
        with torch.autocast("cpu", torch.bfloat16, enabled=settings.precision == "bf16"):
            given = states, actions, text, self.signal, settings.committed, self.generator
            parts = losses(self.network, *given, self.objective)
        total = parts[0] + parts[1]
        if not torch.isfinite(total):
            raise ConfigError(f"the loss is not finite at step {self.step}: try a lower --learning-rate, or fp32")
        self.optimiser.zero_grad(set_to_none=True)
        total.backward()  # type: ignore[no-untyped-call]
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        self.average.update(self.network)
        self.step += 1
        return parts[0].item(), parts[1].item()

    def _held_out(self) -> dict[str, float]:
        return {self.LOSS: self._validation_loss()}

    def _validation_loss(self, count: int = 1024) -> float:
        """Action loss of the averaged network on held-out windows, the same noise every time."""
        import torch

        from servoid.policy.diffusion.model.denoiser import Denoiser
        from servoid.policy.diffusion.objective import Objective, losses

        network = Denoiser(self.config).eval()
        network.load_state_dict(self.average.weights)
        states, actions, text = self.windows.held_out(count)
        with torch.inference_mode():
            given = states, actions, text, self.signal, self.settings.committed, torch.Generator().manual_seed(0)
            # The same measure whatever else is trained for, so that runs can be compared.
            objective = Objective(self.objective.near_actions, self.objective.far_actions)
            return losses(network, *given, objective)[1].item()

    def _ship(self, path: Path, results: Mapping[str, float]) -> None:
        from servoid.policy.diffusion.model import checkpoint

        checkpoint.save(
            path,
            self.average.weights,
            self.config,
            self.windows.states,
            self.windows.actions,
            self.robot,
            data=self.source,
            licence=self.licence,
            results={**self.progress, **results, **({"begun_with": self.begun_with} if self.begun_with else {})},
            training=asdict(self.settings),
            latents=self.windows.latents,
        )

    def _state(self) -> dict[str, Any]:
        return {
            "config": asdict(self.config),
            "network": self.network.state_dict(),
            "average": self.average.weights,
            "updates": self.average.updates,
            "optimiser": self.optimiser.state_dict(),
            "generator": self.generator.get_state(),
            "source": self.source,
            "begun_with": self.begun_with,
            "latents": _tensors(self.windows.latents.to_tensors() if self.windows.latents else {}),
            # Whole, with the matrix of the emphasis: another seed or --init may have made them.
            "states": _tensors(self.windows.states.to_numpy()),
            "actions": _tensors(self.windows.actions.to_numpy()),
        }

    def _restore(self, path: Path, saved: Mapping[str, Any]) -> None:
        from servoid.policy.diffusion.features import Normaliser

        same(path, "another network", asdict(self.config), saved["config"])
        if saved["source"] != self.source:
            raise ConfigError(
                f"{path}: trained on {saved['source']}, not on {self.source}; use --no-resume or another --out"
            )
        latents = _arrays(saved["latents"])
        ours = self.windows.latents.to_tensors() if self.windows.latents else {}
        if ours.keys() != latents.keys() or any((ours[name] != latents[name]).any() for name in ours):
            raise ConfigError(f"{path}: trained with other latents; use --no-resume or another --out")
        self.windows.states, self.windows.actions = (
            Normaliser.from_numpy(_arrays(saved[name])).to_torch() for name in ("states", "actions")
        )
        self.begun_with = saved.get("begun_with", {})  # unknown to an older program
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

"""`servoid train diffusion`: train the diffusion planner-controller on a recorded dataset."""

from __future__ import annotations

import argparse
import math
import os
import sys
import time
from collections.abc import Callable, Mapping
from dataclasses import asdict, dataclass
from functools import partial
from importlib import import_module
from pathlib import Path
from typing import TYPE_CHECKING, Any

from hw.config import ConfigError

if TYPE_CHECKING:
    import torch

    from hw.robot import Robot
    from policy.diffusion.config import DenoiserConfig
    from policy.diffusion.dataset import Windows

# From a checkpoint's path to what was measured; "survival" in it is the share of worlds that stayed up, 0 to 1.
Survival = Callable[[Path], Mapping[str, float]]

MEANS = ("minutes", "loss", "state_loss", "action_loss", "learning_rate", "tokens_per_s")
COLUMNS = (*MEANS, "validation_action_loss", "survival", "velocity_error")
OBJECTIVE = ("near_actions", "far_actions", "min_snr", "action_rate", "monotone")


@dataclass(frozen=True)
class Settings:
    """How to train; times in minutes of training, evaluation not counted."""

    minutes: float = 45.0
    batch: int = 128
    learning_rate: float = 6e-4
    weight_decay: float = 1e-3
    warmup_steps: int = 200
    committed: int = 2  # actions to come that may be given, because they run while a plan is made
    average: float = 0.999
    evaluate_every: float = 5.0
    seed: int = 0
    precision: str = "bf16"
    near_actions: int = 8  # this and the rest: see `policy.diffusion.training.Objective`
    far_actions: float = 0.2
    min_snr: float = 0.0
    action_rate: float = 0.0
    monotone: float = 0.0


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `servoid train diffusion`."""
    d = Settings()
    parser.add_argument("--data", type=Path, required=True, help="dataset folder, as `servoid collect` writes it")
    parser.add_argument("--out", type=Path, required=True, help="folder of the run: checkpoints, logs, learning curve")
    parser.add_argument("--robot", default="op3", help="robot name or file (default op3)")
    parser.add_argument("--minutes", type=float, default=d.minutes, help="training time; evaluations come on top")
    parser.add_argument("--resume", action=argparse.BooleanOptionalAction, default=True, help="continue in --out")
    parser.add_argument("--init", type=Path, help="checkpoint to begin from; its normalisation is kept")
    parser.add_argument("--batch", type=int, default=d.batch)
    parser.add_argument("--learning-rate", type=float, default=d.learning_rate)
    parser.add_argument("--layers", type=int, default=2)
    parser.add_argument("--width", type=int, default=192)
    parser.add_argument("--heads", type=int, default=4)
    parser.add_argument("--history", type=int, default=4, help="past and present states (ticks)")
    parser.add_argument("--horizon", type=int, default=16, help="ticks to come")
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
        "--monotone", type=float, default=d.monotone, help="share of windows with rising noise levels, 0 to 0.5"
    )
    parser.add_argument("--precision", choices=("bf16", "fp32"), default=d.precision)
    parser.add_argument("--threads", type=int, default=os.cpu_count(), help="torch threads (default: all cores)")
    parser.add_argument("--evaluate-every", type=float, default=d.evaluate_every, help="minutes; 0: only at the end")
    parser.add_argument("--survival-seconds", type=float, default=10.0)
    parser.add_argument("--survival-worlds", type=int, default=32, help="0: keep the best by validation loss instead")
    parser.add_argument("--licence", default="Apache-2.0", help="licence of the data, kept in the checkpoint")
    parser.add_argument("--seed", type=int, default=d.seed)


def main(args: argparse.Namespace) -> int:
    """Train; returns 0 when the time budget is used up. Raises ConfigError."""
    # Threads that spin while they wait for each other make a step ten times slower when another program is running.
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # read when torch is loaded
    import torch

    from hw.robot import load_robot
    from policy.diffusion.config import DenoiserConfig
    from policy.diffusion.dataset import Windows, read_recording
    from policy.diffusion.features import token_layout
    from policy.text.encoder import load_encoder

    survival = _survival(args) if args.survival_worlds else None
    torch.set_num_threads(args.threads)
    robot = load_robot(args.robot)
    shape = ("layers", "width", "heads", "history", "horizon", "levels", "mask", "text")
    n = len(robot.joints)
    config = DenoiserConfig(
        token_layout(n).size * (2 if args.emphasis else 1),
        n,
        text_size=load_encoder(args.text).size if args.text else 0,
        **{name: getattr(args, name) for name in shape},
    )
    names = ("minutes", "batch", "learning_rate", "committed", "evaluate_every", "seed", "precision", *OBJECTIVE)
    settings = Settings(**{name: getattr(args, name) for name in names})
    recording = read_recording(args.data, robot)
    windows = Windows(recording, robot, config, emphasis=args.emphasis, seed=args.seed)
    source = f"{args.data.resolve().name}: {len(recording.spans)} episodes, {len(recording.raw)} ticks"
    trainer = Trainer(windows, robot, config, settings, args.out, source, args.licence, survival)
    if not (args.resume and trainer.resume()) and args.init is not None:
        trainer.begin_from(args.init)
    trainer.run()
    return 0


def _survival(args: argparse.Namespace) -> Survival:
    """The closed-loop measurement, looked for before training starts. Raises ConfigError."""
    try:
        measure = import_module("tools.train.survival").closed_loop_survival
    except (ImportError, AttributeError) as error:
        raise ConfigError(
            f"closed-loop survival cannot be measured ({error}); "
            "--survival-worlds 0 keeps the best checkpoint by validation loss instead"
        ) from error
    seconds, worlds = args.survival_seconds, args.survival_worlds
    return partial(measure, seconds=seconds, worlds=worlds, seed=args.seed, robot_name=args.robot)


class Trainer:
    """One run in one folder.

    `last.safetensors` is the newest averaged network, `best.safetensors` the one with the best closed-loop survival
    (ties: the lower validation loss of the actions), `resume.pt` all that is needed to go on.
    """

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

        from policy.diffusion.denoiser import Denoiser
        from policy.diffusion.schedule import cosine_signal
        from policy.diffusion.training import Average, Objective

        if settings.committed > config.horizon:
            raise ConfigError(f"--committed {settings.committed} is longer than the horizon of {config.horizon} ticks")
        self.objective = Objective(**{name: getattr(settings, name) for name in OBJECTIVE})
        torch.manual_seed(settings.seed)
        self.windows, self.robot, self.config, self.settings = windows, robot, config, settings
        self.out, self.source, self.licence, self.survival = out, source, licence, survival
        self.network = Denoiser(config)
        self.average = Average(self.network, settings.average)
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), settings.learning_rate, betas=(0.9, 0.99), weight_decay=settings.weight_decay
        )
        self.signal = torch.as_tensor(cosine_signal(config.levels), dtype=torch.float32)
        self.generator = torch.Generator().manual_seed(settings.seed)
        self.step = 0
        self.seconds = 0.0  # of training, evaluations not counted
        self.evaluated = 0.0  # training time at the last evaluation
        self.best: tuple[float, float] | None = None  # survival, minus the validation loss
        out.mkdir(parents=True, exist_ok=True)

    def begin_from(self, path: Path) -> None:
        """Take weights and normalisation of a checkpoint, to go on with other data. Raises ConfigError."""
        from policy.diffusion.checkpoint import load

        model = load(path, self.robot)
        if model.config != self.config:
            raise ConfigError(f"{path}: another network than the options ask for: {model.config}")
        self.network.load_state_dict(model.denoiser.state_dict())
        self.average.weights = {name: p.detach().clone() for name, p in self.network.named_parameters()}
        self.windows.states, self.windows.actions = model.states, model.actions

    # -- a run -----------------------------------------------------------------------------------------------------

    def run(self) -> None:
        """Train until the time is used up. Interrupted, it saves first what `resume` needs."""
        from tqdm import tqdm

        from tools.train.journal import Journal

        budget = 60 * self.settings.minutes
        every = 60 * self.settings.evaluate_every or math.inf
        size = f"{self.network.parameter_count:,} parameters, {self.config.tokens} tokens"
        windows = f"{len(self.windows.training):,} windows"
        print(f"training {size} on {windows}, {self.settings.minutes:g} minutes, in {self.out}", file=sys.stderr)
        with (
            Journal(self.out, COLUMNS, self.step) as journal,
            tqdm(total=round(budget), initial=round(self.seconds), unit="s", file=sys.stderr, mininterval=2) as bar,
        ):
            try:
                while self.seconds < budget:
                    due = max(self.evaluated + every - self.seconds, 0.0)
                    self._train_for(min(budget - self.seconds, due, 10.0), journal, bar)
                    if self.seconds - self.evaluated >= every and self.seconds < budget:
                        self._evaluate(journal, bar)
                if self.evaluated < self.seconds:
                    self._evaluate(journal, bar)
            except KeyboardInterrupt:
                self.save()
                print(f"interrupted: the same command goes on from step {self.step}", file=sys.stderr)
                raise

    def _train_for(self, seconds: float, journal: Any, bar: Any) -> None:
        """Train for about `seconds` and log the means."""
        sums, steps, start = [0.0, 0.0], 0, time.perf_counter()
        before = self.seconds
        while self.seconds - before < seconds or not steps:
            state_loss, action_loss = self._step()
            sums = [sums[0] + state_loss, sums[1] + action_loss]
            steps += 1
            self.seconds = before + time.perf_counter() - start
        elapsed = self.seconds - before
        state_loss, action_loss = sums[0] / steps, sums[1] / steps
        speed = steps * self.settings.batch * self.config.tokens / elapsed
        journal.log(
            self.step,
            {
                "minutes": self.seconds / 60,
                "loss": state_loss + action_loss,
                "state_loss": state_loss,
                "action_loss": action_loss,
                "learning_rate": self.optimiser.param_groups[0]["lr"],
                "tokens_per_s": speed,
            },
        )
        bar.update(round(self.seconds) - bar.n)
        bar.set_postfix_str(
            f"step {self.step}, states {state_loss:.3f}, actions {action_loss:.3f}, "
            f"{1000 * elapsed / steps:.0f} ms/step, {speed:,.0f} tokens/s"
        )

    def _step(self) -> tuple[float, float]:
        import torch

        from policy.diffusion.training import losses

        settings = self.settings
        progress = min(1.0, self.seconds / (60 * settings.minutes))
        warm = min(1.0, (self.step + 1) / settings.warmup_steps)
        rate = settings.learning_rate * warm * (0.5 + 0.5 * math.cos(math.pi * progress))
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

    # -- evaluation ------------------------------------------------------------------------------------------------

    def _evaluate(self, journal: Any, bar: Any) -> None:
        """Save, measure loss and survival of the averaged network, and keep it when it is the best so far."""
        loss = self._validation_loss()
        last = self.out / "last.safetensors"
        self._ship(last, {"validation_action_loss": loss})
        self.save()
        results: dict[str, float] = {"validation_action_loss": loss}
        if self.survival is not None:
            results |= {name: float(value) for name, value in self.survival(last).items()}
        score = (results.get("survival", 0.0), -loss)
        if better := self.best is None or score > self.best:
            self.best = score
            self._ship(self.out / "best.safetensors", results)
        self.evaluated = self.seconds
        self.save()
        row = {name: value for name, value in results.items() if name in COLUMNS}
        journal.log(self.step, {"minutes": self.seconds / 60, **row})
        panels = [["state_loss", "action_loss", "validation_action_loss"], ["survival"], ["velocity_error"]]
        journal.plot(self.out / "learning_curve.png", panels, x="minutes")
        text = ", ".join(f"{name} {value:.4g}" for name, value in results.items())
        note = " (best)" if better else ""
        bar.write(f"step {self.step}, {self.seconds / 60:.1f} min: {text}{note}", file=sys.stderr)

    def _validation_loss(self, count: int = 1024) -> float:
        """Action loss of the averaged network on held-out windows, the same noise every time."""
        import torch

        from policy.diffusion.denoiser import Denoiser
        from policy.diffusion.training import Objective, losses

        network = Denoiser(self.config).eval()
        network.load_state_dict(self.average.weights)
        states, actions, text = self.windows.held_out(count)
        with torch.inference_mode():
            given = states, actions, text, self.signal, self.settings.committed, torch.Generator().manual_seed(0)
            # The same measure whatever else is trained for, so that runs can be compared.
            objective = Objective(self.objective.near_actions, self.objective.far_actions)
            return losses(network, *given, objective)[1].item()

    # -- files -----------------------------------------------------------------------------------------------------

    def _ship(self, path: Path, results: Mapping[str, float]) -> None:
        from policy.diffusion import checkpoint

        checkpoint.save(
            path,
            self.average.weights,
            self.config,
            self.windows.states,
            self.windows.actions,
            self.robot,
            data=self.source,
            licence=self.licence,
            results={"step": self.step, "minutes": round(self.seconds / 60, 2), **results},
            training=asdict(self.settings),
        )

    def save(self) -> None:
        """Write `resume.pt`, whole or not at all."""
        import torch

        path = self.out / "resume.pt"
        part = path.with_suffix(".part")
        torch.save(
            {
                "config": asdict(self.config),
                "network": self.network.state_dict(),
                "average": self.average.weights,
                "updates": self.average.updates,
                "optimiser": self.optimiser.state_dict(),
                "generator": self.generator.get_state(),
                "states": [self.windows.states.mean, self.windows.states.std],
                "actions": [self.windows.actions.mean, self.windows.actions.std],
                "step": self.step,
                "seconds": self.seconds,
                "evaluated": self.evaluated,
                "best": list(self.best) if self.best else [],
            },
            part,
        )
        part.replace(path)

    def resume(self) -> bool:
        """Go on where the run in the folder stopped, if there is one. Raises ConfigError when it does not fit."""
        import pickle

        import torch

        path = self.out / "resume.pt"
        if not path.exists():
            return False
        try:
            saved: dict[str, Any] = torch.load(path, weights_only=True)
        except (RuntimeError, EOFError, OSError, pickle.UnpicklingError) as error:
            raise ConfigError(f"{path}: cannot be resumed ({error}); use --no-resume or another --out") from error
        ours = asdict(self.config)
        changed = [f"{k} was {saved['config'].get(k)}, is {v}" for k, v in ours.items() if saved["config"].get(k) != v]
        if changed:
            what = "; ".join(changed)
            raise ConfigError(f"{path}: another network ({what}); use its options, --no-resume or another --out")
        ours_norm: list[torch.Tensor] = [self.windows.states.mean, self.windows.actions.mean]
        if any(not torch.equal(a, saved[k][0]) for k, a in zip(("states", "actions"), ours_norm, strict=True)):
            raise ConfigError(f"{path}: trained on other data; use --no-resume or another --out")
        self.network.load_state_dict(saved["network"])
        self.average.weights = saved["average"]
        self.average.updates = saved["updates"]
        self.optimiser.load_state_dict(saved["optimiser"])
        self.generator.set_state(saved["generator"])
        self.step, self.seconds, self.evaluated = saved["step"], saved["seconds"], saved["evaluated"]
        self.best = (saved["best"][0], saved["best"][1]) if saved["best"] else None
        print(f"resumed at step {self.step}, {self.seconds / 60:.1f} minutes", file=sys.stderr)
        return True

"""Train a motion prior, a diffusion model of short windows of motion (SMP), on recorded datasets.

The folder of --data is a dataset of `servoid collect`, or holds one for each style, in a folder named after it. A
prior is judged by the error of the noise that it predicts in windows that it did not see (`error`). Beside it is what
it makes of what they are not: the same windows played backward (`reversed_error`), at rest in their last frame
(`still_error`) and with three tenths of their amplitude (`shuffling_error`). Where there are styles, a small classifier
learns beside it to tell them: `style`, `upper_style` and `lower_style` are the shares of those windows in which it
does, by the whole body and by each half.

Ctrl-C saves, and the same command continues. The best network is prior.safetensors.
"""

from __future__ import annotations

import argparse
import math
import os
from collections.abc import Mapping
from dataclasses import asdict, fields
from pathlib import Path
from typing import TYPE_CHECKING, Any

from servoid.hw.config import ConfigError
from servoid.policy.checkpoint import Origin
from servoid.tools.learn.flags import plain, read_settings
from servoid.tools.learn.prior_settings import PriorShape, PriorTraining
from servoid.tools.learn.trainers.trainer import Trainer, add_run_arguments, require_same

if TYPE_CHECKING:
    from torch import Tensor

    from servoid.hw.robot.description import Robot
    from servoid.policy.priors.features import PriorFeatures
    from servoid.policy.priors.score_matching.model import Prior
    from servoid.policy.priors.score_matching.windows import PriorWindows
    from servoid.policy.recording import Recording
    from servoid.tools.learn.envs.score_term import Rival

_WARMUP = 200  # steps
_TELLING = 1e-3  # learning rate of the classifier of styles
_SHUFFLE = 0.3  # of the amplitude: what walks under a weak prior does so


def add_arguments(parser: argparse.ArgumentParser) -> None:
    """Add the options of `servoid train prior`."""
    add_run_arguments(parser, PriorTraining(), data=True)


def main(args: argparse.Namespace) -> int:
    """Train; returns 0 when the budget is used up. Raises ConfigError."""
    os.environ.setdefault("OMP_WAIT_POLICY", "passive")  # read when torch is loaded
    import torch

    from servoid.hw.robot.description import load_robot
    from servoid.policy.priors.features import PriorFeatures
    from servoid.policy.priors.manner import manner_by_speed
    from servoid.policy.priors.score_matching.network import PriorConfig
    from servoid.policy.priors.score_matching.windows import PriorWindows, WindowSelection
    from servoid.policy.recording import source_of
    from servoid.sim.kinematics import limbs_of

    settings = read_settings(args, PriorTraining())
    torch.set_num_threads(args.threads)
    robot = load_robot(args.robot)
    recordings = read_by_style(args.data, robot)
    boxes = [recording.box is not None for recording in recordings.values()]
    if any(boxes) != all(boxes):
        raise ConfigError(f"{args.data}: only some of its datasets show a box: a prior is of all of them, or of none")
    features = PriorFeatures(robot, limbs_of(robot), all(boxes))
    shape = {f.name: getattr(settings, f.name) for f in fields(PriorShape)}
    config = PriorConfig(features.layout.size, **shape, styles=tuple(style for style in recordings if style))
    chosen = WindowSelection(**{f.name: getattr(settings, f.name) for f in fields(WindowSelection)})
    windows = PriorWindows(recordings, features, config, chosen)
    sources = [source_of(args.data / style, recording) for style, recording in recordings.items()]
    trainer = PriorTrainer(windows, features, settings, args.out, "; ".join(sources))
    trainer.manner = manner_by_speed(list(recordings.values()), robot)
    trainer.start(args.resume)
    trainer.run()
    return 0


def read_by_style(folder: Path, robot: Robot) -> dict[str, Recording]:
    """The datasets in `folder` by style; of one that is a dataset itself, that alone, under an empty name.

    Raises DatasetError.
    """
    from servoid.policy.recording import read_recording

    styles = sorted(path.parent.name for path in folder.glob("*/meta") if path.is_dir())
    if (folder / "meta").is_dir() or not styles:
        return {"": read_recording(folder, robot)}
    return {style: read_recording(folder / style, robot) for style in styles}


def learning_rival(folder: Path, prior: Prior, seed: int) -> Rival:
    """A discriminator of the datasets in `folder` from what a policy does, for windows like those of `prior`. Raises
    DatasetError."""
    from servoid.policy.priors.adversarial.discriminator import Adversary, Discriminator
    from servoid.policy.priors.score_matching.windows import PriorWindows, WindowSelection
    from servoid.tools.learn.envs.score_term import Rival

    discriminator = Discriminator(prior)
    how = prior.header.get("training", {})  # the same windows as the prior learned from
    chosen = WindowSelection(**{name: how[name] for name in ("standing", "mirrored", "moving") if name in how})
    data = PriorWindows(read_by_style(folder, prior.features.robot), prior.features, prior.config, chosen)
    return Rival(discriminator, Adversary(discriminator, data, seed))


class PriorTrainer(Trainer):
    """Trains the denoiser; checkpoints hold the averaged network."""

    settings: PriorTraining
    manner: Mapping[str, Any] = {}  # of the data

    BEST = "prior.safetensors"
    LOSS = "error"
    columns = (
        "loss",
        "learning_rate",
        "steps_per_s",
        "error",
        "error_high",
        "error_middle",
        "error_low",
        "reversed_error",
        "still_error",
        "shuffling_error",
        "style",
        "upper_style",
        "lower_style",
    )
    panels = (
        ("loss", "error", "reversed_error", "still_error", "shuffling_error"),
        ("error_high", "error_middle", "error_low"),
        ("style", "upper_style", "lower_style"),
    )

    def __init__(
        self, windows: PriorWindows, features: PriorFeatures, settings: PriorTraining, out: Path, source: str
    ) -> None:
        import torch

        from servoid.policy.diffusion.objective import Average
        from servoid.policy.diffusion.schedule import cosine_signal
        from servoid.policy.priors.score_matching.network import PriorNetwork
        from servoid.policy.priors.score_matching.styles import StyleClassifier

        super().__init__(out, settings, source)
        torch.manual_seed(settings.seed)
        self.windows, self.features, self.config = windows, features, windows.config
        self.network = PriorNetwork(self.config)
        self.average = Average(self.network, settings.average)
        self.optimiser = torch.optim.AdamW(
            self.network.parameters(), settings.learning_rate, betas=(0.9, 0.99), weight_decay=settings.weight_decay
        )
        self.classifier = StyleClassifier(self.config, features) if self.config.styles else None
        tells = [] if self.classifier is None else list(self.classifier.parameters())
        self._tells = torch.optim.Adam(tells, _TELLING) if tells else None
        self.signal = torch.as_tensor(cosine_signal(self.config.levels), dtype=torch.float32)
        self.generator = torch.Generator().manual_seed(settings.seed)

    @property
    def title(self) -> str:
        styles = f", {len(self.config.styles)} styles" if self.config.styles else ""
        return (
            f"a prior of {self.network.parameter_count:,} parameters on {len(self.windows.training):,} windows{styles}"
        )

    @property
    def following(self) -> str:
        task = "carry" if self.features.box else "speed"
        return f"servoid train policy --task {task} --prior {self.best_path} --out runs/{task}"

    def learn(self) -> dict[str, float]:
        import torch

        s = self.settings
        rate = s.learning_rate * min(1.0, (self.step + 1) / _WARMUP) * (0.5 + 0.5 * math.cos(math.pi * self.share))
        for group in self.optimiser.param_groups:
            group["lr"] = rate
        clean, styles = self.windows.draw(s.batch, self.generator)
        self._tell(clean, styles)
        styles = styles * (torch.rand(len(styles), generator=self.generator) >= s.unstyled)
        levels = torch.randint(1, self.config.levels + 1, (len(clean),), generator=self.generator)
        signal = self.signal[levels][:, None, None]
        noise = torch.randn(clean.shape, generator=self.generator)
        predicted = self.network(signal.sqrt() * clean + (1 - signal).sqrt() * noise, levels, styles)
        loss = (predicted - noise).square().mean()
        if not torch.isfinite(loss):
            raise ConfigError(f"the loss is not finite at step {self.step}: try a lower --learning-rate")
        self.optimiser.zero_grad(set_to_none=True)
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.network.parameters(), 1.0)
        self.optimiser.step()
        self.average.update(self.network)
        self.step += 1
        return {"loss": loss.item(), "learning_rate": rate}

    def _tell(self, windows: Tensor, styles: Tensor) -> None:
        """The classifier, if any, learns from a batch, too."""
        if self.classifier is None or self._tells is None:
            return
        loss = self.classifier.loss(windows, styles, self.generator)
        self._tells.zero_grad(set_to_none=True)
        loss.backward()  # type: ignore[no-untyped-call]
        self._tells.step()

    def shown(self, means: Mapping[str, float], steps_per_s: float) -> tuple[dict[str, float], str]:
        return {"steps_per_s": steps_per_s}, f"loss {means['loss']:.4f}, {steps_per_s:.0f} steps/s"

    def held_out(self, count: int = 4096) -> dict[str, float]:
        """Errors on held-out windows: of the levels that rewards use, highest first, and their mean; and of what those
        windows are not."""
        from servoid.policy.priors.score_matching.model import Style
        from servoid.policy.priors.score_matching.score import Score

        prior = self._prior()
        normalised, styles = self.windows.held_out(count)
        windows = prior.decode(normalised)
        errors = Score(prior, Style(), 0)(windows).mean(0)
        speeds = [self.features.layout.slice(name) for name in ("velocity", "angular_velocity")]
        backward, still = windows.flip(1), windows[:, -1:].expand_as(windows).clone()
        for at in speeds:
            backward[..., at] *= -1.0
            still[..., at] = 0.0
        middle = windows.mean(1, keepdim=True)
        shuffling = middle + _SHUFFLE * (windows - middle)
        named = {"reversed_error": backward, "still_error": still, "shuffling_error": shuffling}
        names = ("error_high", "error_middle", "error_low")
        return {
            "error": float(errors.mean()),
            **{name: float(error) for name, error in zip(names, errors, strict=True)},
            **{name: float(Score(prior, Style(), 0)(unlike).mean()) for name, unlike in named.items()},
            **self._told(normalised, styles),
        }

    def _told(self, windows: Tensor, styles: Tensor) -> dict[str, float]:
        """Shares of held-out windows whose style the classifier tells, by the body and by its halves."""
        if self.classifier is None:
            return {}
        right = (self.classifier.told(windows) == styles).float().mean(1)
        return dict(zip(("style", "upper_style", "lower_style"), right.tolist(), strict=True))

    def _prior(self) -> Prior:
        """The averaged network as it is used."""
        from servoid.policy.priors.score_matching.model import Prior
        from servoid.policy.priors.score_matching.network import PriorNetwork

        network = PriorNetwork(self.config)
        network.load_state_dict(self.average.weights, strict=False)
        network.eval().requires_grad_(False)
        return Prior(network, self.features, self.windows.mean, self.windows.std, self.manner, {}, self.classifier)

    def ship(self, path: Path, results: Mapping[str, Any]) -> None:
        from servoid.policy.priors.score_matching.model import TrainedPrior, save_prior

        windows = self.windows
        weights, tells = self.average.weights, {} if self.classifier is None else self.classifier.state_dict()
        trained = TrainedPrior(weights, self.config, self.features, windows.mean, windows.std, self.manner, tells)
        save_prior(path, trained, Origin(self.source, self.settings.licence, results, plain(self.settings)))

    def state(self) -> dict[str, Any]:
        return {
            "config": {**asdict(self.config), "styles": list(self.config.styles)},
            "network": self.network.state_dict(),
            "average": self.average.weights,
            "updates": self.average.updates,
            "optimiser": self.optimiser.state_dict(),
            "classifier": None if self.classifier is None else self.classifier.state_dict(),
            "tells": None if self._tells is None else self._tells.state_dict(),
            "generator": self.generator.get_state(),
        }

    def restore(self, path: Path, saved: Mapping[str, Any]) -> None:
        ours = {**asdict(self.config), "styles": list(self.config.styles)}
        require_same(path, "another network", ours, saved["config"])
        self.network.load_state_dict(saved["network"])
        self.average.weights = saved["average"]
        self.average.updates = saved["updates"]
        self.optimiser.load_state_dict(saved["optimiser"])
        if self.classifier is not None and self._tells is not None:
            self.classifier.load_state_dict(saved["classifier"])
            self._tells.load_state_dict(saved["tells"])
        self.generator.set_state(saved["generator"])

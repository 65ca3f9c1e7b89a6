"""A motion prior: a denoiser of windows with what turns features into its inputs, and its checkpoint."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.hw.robot.limbs import Limbs
from servoid.policy import checkpoint
from servoid.policy.checkpoint import CheckpointError, Origin
from servoid.policy.priors.features import PriorFeatures
from servoid.policy.priors.score_matching.network import PriorConfig, PriorNetwork
from servoid.policy.priors.score_matching.styles import StyleClassifier

KIND = "prior"  # of a checkpoint
_LIMB_TOLERANCE = 1e-4  # m by which a limb may differ from that of the robot that the prior was trained for


@dataclass(frozen=True)
class Style:
    """Which of a prior's styles counts: one for all, or another for the legs and the root. None: any."""

    upper: str | None = None
    lower: str | None = None
    weight: float = 1.0  # of classifier-free guidance; at 1, SMP's, the conditioned prediction alone counts

    @classmethod
    def parse(cls, text: str | None, weight: float = 1.0) -> Style:
        """As typed: nothing, `NAME`, or `UPPER+LOWER`."""
        upper, plus, lower = (text or "").partition("+")
        return cls(upper or None, (lower if plus else upper) or None, weight)


@dataclass(frozen=True)
class Prior:
    """A frozen denoiser of windows. `mean` and `std` are torch tensors `(size,)`."""

    network: PriorNetwork
    features: PriorFeatures
    mean: Tensor
    std: Tensor
    manner: Mapping[str, Any]  # of the data by speed: see `servoid.policy.priors.manner`
    header: Mapping[str, Any]
    classifier: StyleClassifier | None = None  # of a prior that knows styles

    @property
    def config(self) -> PriorConfig:
        return self.network.config

    @property
    def joint_deviation(self) -> Array:
        """How far joints move in the data `(n_joints,)` rad, standard deviation."""
        return self.std[self.features.layout.slice("position")].numpy()

    def encode(self, windows: Tensor) -> Tensor:
        return (windows - self.mean) / self.std

    def decode(self, windows: Tensor) -> Tensor:
        return windows * self.std + self.mean

    def shown(self, windows: Tensor, style: Style) -> Mapping[str, float]:
        """Shares of windows in physical units that show `style`, by the classifier: see `StyleClassifier.shares`.

        Empty where no style is asked for. Raises ConfigError for an unknown one.
        """
        upper, lower = self.config.style(style.upper), self.config.style(style.lower)
        if self.classifier is None or not (upper and lower):
            return {}
        return self.classifier.shares(self.encode(windows), upper, lower)

    def noise(self, noisy: Tensor, levels: Tensor, style: Style) -> Tensor:
        """The noise in normalised windows `(batch, frames, size)` at `levels` `(batch,)`, under a style.

        Styles are composed by features, upper body and lower (SMP, section 8.1). Raises ConfigError for an unknown one.
        """
        lower = self._guided(noisy, levels, self.config.style(style.lower), style.weight)
        if style.upper == style.lower:
            return lower
        upper = self._guided(noisy, levels, self.config.style(style.upper), style.weight)
        return torch.where(torch.from_numpy(self.features.lower), lower, upper)

    def _guided(self, noisy: Tensor, levels: Tensor, style: int, weight: float) -> Tensor:
        """f(x) + w (f(x, style) - f(x)): classifier-free guidance."""
        predicted = self.network(noisy, levels, torch.full_like(levels, style))
        if style == 0 or weight == 1.0:
            return predicted
        free = self.network(noisy, levels, torch.zeros_like(levels))
        return free + weight * (predicted - free)


@dataclass(frozen=True)
class TrainedPrior:
    """What training made: a network's weights (a state_dict), and what turns features into its inputs."""

    weights: Mapping[str, Tensor]
    config: PriorConfig
    features: PriorFeatures
    mean: Tensor
    std: Tensor
    manner: Mapping[str, Any]
    classifier: Mapping[str, Tensor] = field(default_factory=dict)  # weights of what tells its styles, if any


def save_prior(path: Path, trained: TrainedPrior, origin: Origin) -> None:
    """Write all that is needed to score and to generate motion. Raises CheckpointError."""
    config = {**asdict(trained.config), "styles": list(trained.config.styles)}
    features = trained.features
    head = checkpoint.header(
        KIND,
        features.robot,
        config=config,
        **vars(origin),
        prior_layout=features.layout.to_header(),
        limbs=features.limbs.to_header(),
        box=features.box,
        manner=dict(trained.manner),
    )
    tensors = {f"network.{k}": v.detach().float().cpu().numpy() for k, v in trained.weights.items()}
    tensors |= {f"classifier.{k}": v.detach().float().numpy() for k, v in trained.classifier.items()}
    tensors |= {"mean": trained.mean.numpy(), "std": trained.std.numpy()}
    checkpoint.write(path, tensors, head)


def load_prior(path: Path, robot: Robot, limbs: Limbs | None = None) -> Prior:
    """Load a prior for `robot`, in evaluation mode; `limbs` are the robot's own, to be compared.

    Raises CheckpointError for another kind, joints, rate, features or limbs, and for one that was never trained.
    """
    head, tensors = checkpoint.read(path)
    checkpoint.check(path, head, KIND, robot)
    if head["results"].get("step", 1) < 1:
        raise CheckpointError(f"{path}: a prior that was trained for 0 steps knows no motion; train it with --minutes")
    if "error" not in head["results"]:
        raise CheckpointError(
            f"{path}: its training was interrupted before it was measured, so nothing says what an error means: go on "
            "with it, and use prior.safetensors"
        )
    try:
        theirs = Limbs.from_header(head["limbs"])
        features = PriorFeatures(robot, theirs, head.get("box", False))
        checkpoint.check_layout(path, "prior", head["prior_layout"], features.layout.to_header())
        config = PriorConfig.from_header(head["config"])
        network = PriorNetwork(config)
        weights = {k: torch.from_numpy(v) for k, v in checkpoint.part(tensors, "network").items()}
        network.load_state_dict(weights, strict=False)
        missing = {name for name, _ in network.named_parameters()} - weights.keys()
        if missing:
            raise KeyError(sorted(missing)[0])
        classifier = None
        if config.styles:
            classifier = StyleClassifier(config, features)
            classifier.load_state_dict(
                {k: torch.from_numpy(v) for k, v in checkpoint.part(tensors, "classifier").items()}
            )
            classifier.eval().requires_grad_(False)
        mean, std = (torch.from_numpy(tensors[name]) for name in ("mean", "std"))
    except CheckpointError:
        raise
    except (KeyError, TypeError, ValueError, RuntimeError, ConfigError) as error:
        raise CheckpointError(f"{path}: its header and its tensors do not fit this program: {error}") from error
    if limbs is not None and not _alike(theirs, limbs):
        raise CheckpointError(
            f"{path}: made for {head['robot']}, whose limbs are not those of {robot.name}: train a prior for this robot"
        )
    network.eval().requires_grad_(False)
    return Prior(network, features, mean, std, head.get("manner", {}), head, classifier)


def _alike(a: Limbs, b: Limbs) -> bool:
    if [limb.joints for limb in a.limbs] != [limb.joints for limb in b.limbs]:
        return False
    pairs = zip(a.limbs, b.limbs, strict=True)
    return all(
        np.allclose(getattr(x, part), getattr(y, part), atol=_LIMB_TOLERANCE)
        for x, y in pairs
        for part in ("anchors", "axes", "tip")
    )

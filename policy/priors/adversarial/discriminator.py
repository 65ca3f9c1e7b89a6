"""Adversarial motion priors (AMP, arXiv:2104.02180), to compare with: a discriminator of the data's windows from the
policy's, which learns along with the policy, or stays as another training left it.

Reward and regularisation are those that the SMP paper's baseline has: -log(1 - D), a penalty on the gradient at the
data's windows, a small one on the logits, and a memory of the policy's older windows.
"""

from __future__ import annotations

from collections.abc import Mapping
from itertools import pairwise
from pathlib import Path
from typing import Any

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from servoid.hw.contracts.body import Array
from servoid.policy import checkpoint
from servoid.policy.checkpoint import CheckpointError
from servoid.policy.priors.adversarial.memory import Memory
from servoid.policy.priors.score_matching.model import Prior
from servoid.policy.priors.score_matching.windows import PriorWindows

KIND = "discriminator"  # of a checkpoint
_HIDDEN = (256, 128)
_RATE, _DECAY = 2.5e-4, 1e-4  # of AdamW
_GRADIENT_PENALTY, _LOGIT_PENALTY = 5.0, 0.01
_SCALE = 2.0  # of the reward
_BATCH, _STEPS = 256, 4  # of an update
_SMALLEST = 1e-4


class Discriminator(nn.Module):
    """A logit of windows `(batch, frames, size)` in physical units: positive for the data's."""

    mean: Tensor
    std: Tensor

    def __init__(self, prior: Prior) -> None:
        """For the windows of `prior`, with its normalisation: the same features, and the same budget."""
        super().__init__()
        self.register_buffer("mean", prior.mean.clone())
        self.register_buffer("std", prior.std.clone())
        self.frames = prior.config.frames
        sizes = (self.frames * prior.config.size, *_HIDDEN)
        layers = [part for a, b in pairwise(sizes) for part in (nn.Linear(a, b), nn.ReLU())]
        self.layers = nn.Sequential(*layers, nn.Linear(sizes[-1], 1))

    def forward(self, windows: Tensor) -> Tensor:
        return self.layers(((windows - self.mean) / self.std).flatten(1))[:, 0]

    @torch.inference_mode()
    def reward(self, windows: Tensor) -> Array:
        """-2 log(1 - D) `(batch,)`, not negative: AMP's, for a discriminator that tells probabilities."""
        likely = torch.sigmoid(self(windows))
        return (-_SCALE * torch.log((1.0 - likely).clamp_min(_SMALLEST))).numpy().astype(float)


class Adversary:
    """A discriminator that learns, from data and from what the policy does."""

    def __init__(self, discriminator: Discriminator, data: PriorWindows, seed: int) -> None:
        self.discriminator, self._data = discriminator, data
        self._optimiser = torch.optim.AdamW(discriminator.parameters(), _RATE, weight_decay=_DECAY)
        self._generator = torch.Generator().manual_seed(seed)
        self.memory = Memory()

    def learn(self) -> dict[str, float]:
        """A few steps; returns how often it tells the data's windows, and the policy's."""
        memory = self.memory.windows
        found: list[tuple[float, float]] = []
        for _ in range(_STEPS):
            mine = Memory.drawn(memory, _BATCH, self._generator)
            real, _ = self._data.draw(_BATCH, self._generator)
            real = (real * self._data.std + self._data.mean).requires_grad_()
            of_data, of_policy = self.discriminator(real), self.discriminator(mine)
            (slope,) = torch.autograd.grad(of_data.sum(), real, create_graph=True)
            steep = (slope * self.discriminator.std).square().sum((1, 2)).mean()  # in normalised windows
            loss = (
                functional.softplus(-of_data).mean()
                + functional.softplus(of_policy).mean()
                + _GRADIENT_PENALTY * steep
                + _LOGIT_PENALTY * (of_data.square().mean() + of_policy.square().mean())
            )
            self._optimiser.zero_grad(set_to_none=True)
            loss.backward()
            self._optimiser.step()
            found.append(((of_data > 0).float().mean().item(), (of_policy < 0).float().mean().item()))
        data, policy = np.mean(found, 0)
        return {"tells_data": float(data), "tells_policy": float(policy)}


def save_discriminator(path: Path, discriminator: Discriminator, prior: Prior, about: Mapping[str, Any]) -> None:
    """Write a discriminator of the windows of `prior`. Raises CheckpointError."""
    features = prior.features
    config = {"frames": prior.config.frames, "stride": prior.config.stride, "hidden": list(_HIDDEN)}
    layout = features.layout.to_header()
    head = checkpoint.header(KIND, features.robot, config=config, prior_layout=layout, **about)
    checkpoint.write(path, {k: v.detach().numpy() for k, v in discriminator.state_dict().items()}, head)


def load_discriminator(path: Path, prior: Prior) -> Discriminator:
    """A discriminator of windows like those of `prior`, frozen. Raises CheckpointError for other ones."""
    head, tensors = checkpoint.read(path)
    checkpoint.check(path, head, KIND, prior.features.robot)
    checkpoint.check_layout(path, "prior", head["prior_layout"], prior.features.layout.to_header())
    for name in ("frames", "stride"):
        theirs, ours = head["config"][name], getattr(prior.config, name)
        if theirs != ours:
            raise CheckpointError(f"{path}: judges windows with {name} {theirs}, but the prior's have {ours}")
    made = Discriminator(prior)
    try:
        made.load_state_dict({k: torch.from_numpy(v) for k, v in tensors.items()})
    except RuntimeError as error:
        raise CheckpointError(f"{path}: its tensors do not fit this program: {error}") from error
    return made.eval().requires_grad_(False)

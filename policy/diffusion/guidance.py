"""What pulls a sample: the gradient of a cost on predicted states, and the instruction, free of a classifier."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from servoid.hw.config import ConfigError

# (states, actions, state levels, action levels) -> clean states, clean actions
Predictor = Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]

ANALYTIC = "analytic"
NETWORK = "network"


class Diverged(ValueError):
    """Sampling left all bounds, or guidance has no gradient: there is no plan. The message says what to change."""


@dataclass(frozen=True)
class Guidance:
    """Loss guidance: predicted clean states move by `-weight * gradient`, never further than `clip`.

    `cost` maps normalised states `(batch, state tokens, features)` to `(batch,)`. `gradient` is "analytic": taken on
    the predicted states themselves, which is cheap; or "network": taken on the noisy states, back through the network
    (UniPhys, eq. 3). `clip` is the norm of a step over one window. Both are in the network's inputs: deviations, or
    their projection where it has emphasis. With `samples` > 1 so many neighbours in the batch are samples of one
    window, and all move by the mean of their gradients (Monte-Carlo guidance, UniPhys, eq. 4).
    """

    cost: Callable[[Tensor], Tensor]
    weight: float
    clip: float
    gradient: str = ANALYTIC
    samples: int = 1

    def __post_init__(self) -> None:
        if self.gradient not in (ANALYTIC, NETWORK):
            raise ConfigError(f"guidance: gradient must be '{ANALYTIC}' or '{NETWORK}', not '{self.gradient}'")

    def step(self, gradient: Tensor, moving: Tensor) -> Tensor:
        """How far states go, `(batch, state tokens, features)`: those `moving` `(state tokens,)`. Raises Diverged."""
        if self.samples > 1:
            mean = gradient.reshape(-1, self.samples, *gradient.shape[1:]).mean(1)
            gradient = mean.repeat_interleave(self.samples, 0)
        step = self.weight * gradient * moving[:, None]  # what does not move uses nothing of the step up
        norm = step.flatten(1).norm(dim=1).clamp_min(1e-12)
        if not torch.isfinite(norm).all():
            if not torch.isfinite(gradient).all():
                raise Diverged("the guidance cost has no finite gradient on this trajectory; check the task's cost")
            raise Diverged(
                f"guidance with a weight of {self.weight:g} moves this trajectory out of all bounds; lower it"
            )
        limited: Tensor = step * (self.clip / norm).clamp_max(1.0)[:, None, None]
        return limited


def classifier_free(denoise: Callable[..., tuple[Tensor, Tensor]], text: Tensor | None, weight: float) -> Predictor:
    """A predictor told `text` `(batch, size)`: `x0 = x0() + weight * (x0(text) - x0())` (Ho and Salimans, 2207.12598).

    `weight` 0 leaves the instruction unread and 1 needs no second window, so both cost one call.
    """
    if text is None or weight == 0.0:
        return denoise
    if weight == 1.0:
        return partial(denoise, text=text)
    text_mask = torch.arange(2 * len(text)) < len(text)
    twice = torch.cat([text, text])

    def predict(states: Tensor, actions: Tensor, *levels: Tensor) -> tuple[Tensor, Tensor]:
        pairs = denoise(
            torch.cat([states, states]), torch.cat([actions, actions]), *levels, text=twice, text_mask=text_mask
        )
        with_text, without = zip(*(x.chunk(2) for x in pairs), strict=True)
        state, action = (b + weight * (a - b) for a, b in zip(with_text, without, strict=True))
        return state, action

    return predict

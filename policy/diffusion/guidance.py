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


@dataclass(frozen=True)
class DenoisingStep:
    """One call's step of all tokens; factors are `(tokens, 1)`, the square roots of what they are of."""

    moving: Tensor  # (tokens,) bool: the others are left alone
    signal_before: Tensor
    noise_before: Tensor
    signal_after: Tensor
    noise_after: Tensor  # of the noise that is kept
    noise_fresh: Tensor  # of that which is drawn anew


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

    At a level with the cumulative signal a, `scaled` multiplies a step by (1 - a) / sqrt(a) through the network and by
    1 - a without: the step is then the covariance of what is unknown, times the gradient, since sqrt(a) / (1 - a)
    of that covariance is the network's Jacobian (Chung et al., arXiv:2209.14687; Song et al., ICLR 2023, PiGDM). Of
    samples of a normal distribution the mean then moves by weight * covariance * gradient, for a cost that is linear.
    `even` gives each token's gradient the same norm, the mean over those that move. With `limited` no step is longer
    than to where the cost would be zero if it were linear. At each level `repeats` steps are taken, each with its share
    of the weight and the gradient where the step before it led.
    """

    cost: Callable[[Tensor], Tensor]
    weight: float
    clip: float
    gradient: str = ANALYTIC
    samples: int = 1
    scaled: bool = False
    even: bool = False
    limited: bool = False
    repeats: int = 1

    def __post_init__(self) -> None:
        if self.gradient not in (ANALYTIC, NETWORK):
            raise ConfigError(f"guidance: gradient must be '{ANALYTIC}' or '{NETWORK}', not '{self.gradient}'")

    def predict(
        self, network: Predictor, states: Tensor, actions: Tensor, levels: tuple[Tensor, Tensor], step: DenoisingStep
    ) -> tuple[Tensor, Tensor]:
        """What a `network` predicts of a noisy window, the states that `step` moves being guided. Raises Diverged."""
        through = self.gradient == NETWORK
        with torch.set_grad_enabled(through):
            source = states.detach().requires_grad_(through)
            predicted, clean_actions = network(source, actions, *levels)
        moved = torch.zeros_like(predicted)
        for again in reversed(range(self.repeats)):
            with torch.enable_grad():
                clean = (predicted.detach() - moved).requires_grad_()
                cost = self.cost(clean)
                (slope,) = torch.autograd.grad(cost.sum(), clean)
            gradient = slope
            if through:
                (gradient,) = torch.autograd.grad(predicted, source, slope, retain_graph=again > 0)
            if self.scaled:
                variance = step.noise_before**2
                gradient = gradient * (variance / step.signal_before if through else variance)
            moved = moved + self._limited(self.step(gradient, step.moving), slope, cost.detach())
        return predicted.detach() - moved, clean_actions.detach()

    def _limited(self, step: Tensor, slope: Tensor, cost: Tensor) -> Tensor:
        """A step cut to where a `cost` `(batch,)` with this `slope` would be zero."""
        if not self.limited:
            return step
        drop = (slope * step).flatten(1).sum(1)
        return step * torch.where(drop > cost, cost / drop.clamp_min(1e-12), 1.0)[:, None, None]

    def step(self, gradient: Tensor, moving: Tensor) -> Tensor:
        """How far states go, `(batch, state tokens, features)`: those `moving` `(state tokens,)`. Raises Diverged."""
        if self.even:
            size = gradient.norm(dim=2, keepdim=True)
            mean = size[:, moving].mean(1, keepdim=True)
            gradient = gradient * (mean / size.clamp_min(1e-12))
        if self.samples > 1:
            mean = gradient.reshape(-1, self.samples, *gradient.shape[1:]).mean(1)
            gradient = mean.repeat_interleave(self.samples, 0)
        weight = self.weight / self.repeats
        step = weight * gradient * moving[:, None]  # what does not move uses nothing of the step up
        norm = step.flatten(1).norm(dim=1).clamp_min(1e-12)
        if not torch.isfinite(norm).all():
            if not torch.isfinite(gradient).all():
                raise Diverged("the guidance cost has no finite gradient on this trajectory; check the task's cost")
            raise Diverged(
                f"guidance with a weight of {self.weight:g} moves this trajectory out of all bounds; lower it"
            )
        limited: Tensor = step * (self.clip / self.repeats / norm).clamp_max(1.0)[:, None, None]
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

"""What pulls a sample: the gradient of a cost on predicted states, and the instruction, free of a classifier."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial

import numpy as np
import torch
from torch import Tensor

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array

# (states, actions, state levels, action levels) -> clean states, clean actions
Predictor = Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]

# The same, and also what takes a gradient on clean states to that on noisy ones, shaped alike
Differentiator = Callable[..., tuple[Tensor, Tensor, Callable[[Array], Array]]]

ANALYTIC = "analytic"
NETWORK = "network"
_LARGEST = 1e38
_DIFFERENCE = 0.05  # length of the step that a Jacobian is taken by: far above what float32 rounds, and short


# Clean states `(batch, state tokens, features)`, normalised -> cost `(batch,)` and its gradient, shaped like the states
CostSlope = Callable[[Array], tuple[Array, Array]]


@dataclass(frozen=True)
class DenoisingStep:
    """One call's step of all tokens, which takes noisy ones to `of_clean` clean + `of_noisy` noisy + `fresh` noise.

    Factors are `(tokens, 1)` float32. Tokens that do not move are left alone by them.
    """

    moving: Array  # (tokens,) bool
    of_clean: Array
    of_noisy: Array
    fresh: Array
    signal: Array  # square roots of what a token holds of signal and of noise before the step
    noise: Array


class Diverged(ValueError):
    """Sampling left all bounds, or guidance has no gradient: there is no plan. The message says what to change."""


@dataclass(frozen=True)
class Guidance:
    """Loss guidance: predicted clean states move by `-weight * gradient`, never further than `clip`.

    `slope` gives the cost of normalised states, and its gradient on them. `gradient` is "analytic": taken on
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

    With `actions` those that are denoised move as well, by `-weight` times the change of predicted actions along the
    gradient: the network's Jacobian of actions by noisy states, which for `scaled` steps makes the covariance of both
    times the gradient. A gradient on actions themselves would be zero where states see no action. The Jacobian is taken
    by a difference, which is one call more; actions go as large a share of their step as states do of theirs.
    """

    slope: CostSlope
    weight: float
    clip: float
    gradient: str = ANALYTIC
    samples: int = 1
    scaled: bool = False
    even: bool = False
    limited: bool = False
    repeats: int = 1
    actions: bool = False
    differentiated: Differentiator | None = None  # of the predictor, for "network"; None: autograd's

    def __post_init__(self) -> None:
        if self.gradient not in (ANALYTIC, NETWORK):
            raise ConfigError(f"guidance: gradient must be '{ANALYTIC}' or '{NETWORK}', not '{self.gradient}'")

    def predict(
        self,
        network: Predictor,
        states: Tensor,
        actions: Tensor,
        levels: tuple[Tensor, Tensor],
        step: DenoisingStep,
        moving_actions: Array | None = None,
    ) -> tuple[Array, Array]:
        """What a `network` predicts of a noisy window, guided: the states that `step` moves, and `moving_actions`
        `(action tokens,)` where actions are guided too. Raises Diverged."""
        through = self.gradient == NETWORK
        if through:
            predicted, clean_actions, back = (self.differentiated or by_autograd(network))(states, actions, *levels)
        else:
            predicted, clean_actions = network(states, actions, *levels)
        clean, along = predicted.numpy(), np.zeros(states.shape, np.float32)
        for _ in range(self.repeats):
            cost, slope = self.slope(clean)
            if not np.isfinite(cost).all():  # its slope may be finite all the same, but leads nowhere
                raise Diverged("the guidance cost is not finite on this trajectory; check the task's cost")
            gradient = back(slope) if through else slope
            if self.scaled:
                gradient = gradient * (step.noise**2 / step.signal if through else step.noise**2)
            moved, share = self.step(gradient, step.moving)
            part = self._limited(moved, slope, cost)
            clean = clean - part * moved
            if self.actions:
                along += part * share * self._along(slope, step)
        acted = clean_actions.numpy()
        if self.actions and moving_actions is not None:
            acted = acted - moving_actions[:, None] * self._change(network, states, actions, levels, along, acted)
        return clean, acted

    def _along(self, slope: Array, step: DenoisingStep) -> Array:
        """A gradient on clean states as a direction of noisy ones, with its share of the weight."""
        along: Array = self._shared(slope) * (
            step.moving[:, None] * np.float32(min(self.weight / self.repeats, _LARGEST))
        )
        return along * (step.noise**2 / step.signal) if self.scaled else along

    @staticmethod
    def _change(
        network: Predictor, states: Tensor, actions: Tensor, levels: tuple[Tensor, Tensor], along: Array, acted: Array
    ) -> Array:
        """By how much predicted actions, `acted`, change with noisy states that go `along`: the network's Jacobian."""
        size = np.sqrt(np.square(along).sum((1, 2), keepdims=True))  # of each window
        reach = np.float32(_DIFFERENCE) / np.maximum(size, np.float32(1e-12))
        with torch.set_grad_enabled(False):
            there = network(states + torch.from_numpy(along * reach), actions, *levels)[1].numpy()
        change: Array = (there - acted) / reach
        return change

    def _shared(self, gradient: Array) -> Array:
        """Of neighbours that are samples of one window, the mean for each."""
        if self.samples == 1:
            return gradient
        return np.repeat(gradient.reshape(-1, self.samples, *gradient.shape[1:]).mean(1), self.samples, 0)

    def _limited(self, step: Array, slope: Array, cost: Array) -> Array | float:
        """How much of a step, `(batch, 1, 1)`, leads to where a `cost` `(batch,)` with this `slope` would be zero."""
        if not self.limited:
            return 1.0
        drop = (slope * step).sum((1, 2))
        share: Array = np.where(drop > cost, cost / np.maximum(drop, 1e-12), 1.0).astype(step.dtype)
        return share[:, None, None]

    def step(self, gradient: Array, moving: Array) -> tuple[Array, Array]:
        """How far states go, `(batch, state tokens, features)`: those `moving` `(state tokens,)`; and what share
        `(batch, 1, 1)` that is of the step that `clip` would not shorten. Raises Diverged."""
        if self.even:
            size = np.linalg.norm(gradient, axis=2, keepdims=True)
            gradient = gradient * (size[:, moving].mean(1, keepdims=True) / np.maximum(size, 1e-12))
        gradient = self._shared(gradient)
        # What does not move uses nothing of the step up; weights are beyond all bounds before float32 is.
        step = gradient * (moving[:, None] * np.float32(min(self.weight / self.repeats, _LARGEST)))
        flat = step.reshape(len(step), -1)
        norm = np.sqrt(np.einsum("bi,bi->b", flat, flat))  # infinite where a square is
        if not np.isfinite(norm).all():
            if not np.isfinite(gradient).all():
                raise Diverged("the guidance cost has no finite gradient on this trajectory; check the task's cost")
            raise Diverged(
                f"guidance with a weight of {self.weight:g} moves this trajectory out of all bounds; lower it"
            )
        share = np.minimum(self.clip / self.repeats / np.maximum(norm, 1e-12), 1.0).astype(step.dtype)[:, None, None]
        return step * share, share


def by_autograd(network: Predictor) -> Differentiator:
    """A predictor and its gradient on noisy states, by torch."""

    def differentiated(states: Tensor, *others: Tensor) -> tuple[Tensor, Tensor, Callable[[Array], Array]]:
        with torch.enable_grad():
            source = states.detach().requires_grad_()
            predicted, clean_actions = network(source, *others)

        def back(pull: Array) -> Array:
            gradient: Array = torch.autograd.grad(predicted, source, torch.from_numpy(pull), retain_graph=True)[
                0
            ].numpy()
            return gradient

        return predicted.detach(), clean_actions.detach(), back

    return differentiated


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

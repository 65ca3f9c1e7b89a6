"""DDIM sampling over a denoising matrix, with known tokens inpainted clean and loss guidance.

Each network call predicts the clean window. Guidance moves the predicted states down the gradient of a cost before the
DDIM step, so the next call, and with it the actions, sees states that follow the cost. Deterministic given its noise
(eta = 0; Song et al., arXiv:2010.02502).
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import partial

import torch
from torch import Tensor

from hw.config import ConfigError
from hw.hal import Array
from policy.diffusion.schedule import DenoisingMatrix

# (states, actions, state levels, action levels) -> clean states, clean actions
Predictor = Callable[[Tensor, Tensor, Tensor, Tensor], tuple[Tensor, Tensor]]

ANALYTIC = "analytic"
NETWORK = "network"


@dataclass(frozen=True)
class Guidance:
    """Loss guidance: predicted clean states move by `-weight * gradient`, never further than `clip`.

    `cost` maps normalised states `(batch, state tokens, features)` to `(batch,)`. `gradient` is "analytic": taken on
    the predicted states themselves, which is cheap; or "network": taken on the noisy states, back through the network
    (UniPhys, eq. 3). `clip` is the norm of a step over one window, in normalised units.
    """

    cost: Callable[[Tensor], Tensor]
    weight: float
    clip: float
    gradient: str = ANALYTIC

    def __post_init__(self) -> None:
        if self.gradient not in (ANALYTIC, NETWORK):
            raise ConfigError(f"guidance: gradient must be '{ANALYTIC}' or '{NETWORK}', not '{self.gradient}'")


@dataclass(frozen=True)
class Known:
    """Tokens that are given, normalised; the masks say which. What lies under False is not read."""

    states: Tensor  # (batch, state tokens, features)
    actions: Tensor  # (batch, action tokens, features)
    state_mask: Tensor  # (state tokens,) bool
    action_mask: Tensor  # (action tokens,) bool


def classifier_free(denoise: Callable[..., tuple[Tensor, Tensor]], text: Tensor | None, weight: float) -> Predictor:
    """A predictor told `text` `(batch, size)`: `x0 = x0() + weight * (x0(text) - x0())` (Ho and Salimans, 2207.12598).

    `weight` 0 leaves the instruction unread and 1 needs no second window, so both cost one call.
    """
    if text is None or weight == 0.0:
        return denoise
    if weight == 1.0:
        return partial(denoise, text=text)
    told = torch.arange(2 * len(text)) < len(text)
    twice = torch.cat([text, text])

    def predict(states: Tensor, actions: Tensor, *levels: Tensor) -> tuple[Tensor, Tensor]:
        pairs = denoise(torch.cat([states, states]), torch.cat([actions, actions]), *levels, text=twice, told=told)
        with_text, without = zip(*(x.chunk(2) for x in pairs), strict=True)
        state, action = (b + weight * (a - b) for a, b in zip(with_text, without, strict=True))
        return state, action

    return predict


def draw_noise(generators: Sequence[torch.Generator], tokens: int, features: int) -> Tensor:
    """Noise `(batch, tokens, features)`, one generator a sample, so that a sample does not depend on its batch."""
    return torch.stack([torch.randn(tokens, features, generator=g) for g in generators])


class Sampler:
    """Walks a denoising matrix with a predictor of clean windows."""

    def __init__(self, predict: Predictor, signal: Array) -> None:
        """`signal` is the cumulative signal of each level (`schedule.cosine_signal`)."""
        self._predict = predict
        self._signal = torch.as_tensor(signal, dtype=torch.float32)

    def sample(
        self,
        matrix: DenoisingMatrix,
        known: Known,
        generators: Sequence[torch.Generator],
        guidance: Guidance | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Clean states and actions, shaped like `known`; all randomness comes from `generators`, one a sample.

        Raises ValueError when the guidance cost has no finite gradient.
        """
        matrix = matrix.hold(known.state_mask.numpy(), known.action_mask.numpy())
        state_rows, action_rows = torch.as_tensor(matrix.states), torch.as_tensor(matrix.actions)
        states = draw_noise(generators, *known.states.shape[1:])
        actions = draw_noise(generators, *known.actions.shape[1:])
        states = torch.where(known.state_mask[:, None], known.states, states)
        actions = torch.where(known.action_mask[:, None], known.actions, actions)
        for call in range(matrix.calls):
            clean_states, clean_actions = self._call(states, actions, state_rows[call], action_rows[call], guidance)
            states = self._step(states, clean_states, state_rows[call], state_rows[call + 1])
            actions = self._step(actions, clean_actions, action_rows[call], action_rows[call + 1])
        return states, actions

    def _call(
        self, states: Tensor, actions: Tensor, state_levels: Tensor, action_levels: Tensor, guidance: Guidance | None
    ) -> tuple[Tensor, Tensor]:
        """One network call, its states moved by guidance."""
        if guidance is None:
            return self._predict(states, actions, state_levels, action_levels)
        if guidance.gradient == NETWORK:
            with torch.enable_grad():
                source = states.detach().requires_grad_()
                clean_states, clean_actions = self._predict(source, actions, state_levels, action_levels)
                (gradient,) = torch.autograd.grad(guidance.cost(clean_states).sum(), source)
            clean_states, clean_actions = clean_states.detach(), clean_actions.detach()
        else:
            clean_states, clean_actions = self._predict(states, actions, state_levels, action_levels)
            with torch.enable_grad():
                source = clean_states.detach().requires_grad_()
                (gradient,) = torch.autograd.grad(guidance.cost(source).sum(), source)
        if not torch.isfinite(gradient).all():
            raise ValueError("the guidance cost has no finite gradient on this trajectory; check the task's cost")
        step = guidance.weight * gradient * (state_levels > 0)[:, None]  # what is known does not move
        norm = step.flatten(1).norm(dim=1).clamp_min(1e-12)
        step = step * (guidance.clip / norm).clamp_max(1.0)[:, None, None]
        return clean_states - step, clean_actions

    def _step(self, noisy: Tensor, clean: Tensor, before: Tensor, after: Tensor) -> Tensor:
        """The DDIM step from levels `before` to `after`, `(tokens,)`; tokens whose level stays are left alone."""
        a, b = self._signal[before][:, None], self._signal[after][:, None]
        noise = (noisy - a.sqrt() * clean) / (1 - a).sqrt().clamp_min(1e-6)
        stepped = b.sqrt() * clean + (1 - b).sqrt() * noise
        return torch.where((after < before)[:, None], stepped, noisy)

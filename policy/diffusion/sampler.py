"""Sampling over a denoising matrix, with known tokens inpainted clean and loss guidance.

Each network call predicts the clean window. Guidance moves the predicted states down the gradient of a cost before the
step to the next levels, so the next call, and with it the actions, sees states that follow the cost. Steps are those of
DDIM (Song et al., arXiv:2010.02502, eq. 12 and 16): deterministic given the first noise with eta = 0, and those of DDPM
(ancestral) with eta = 1.
"""

from __future__ import annotations

from collections.abc import Callable, Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from servoid.hw.contracts.body import Array
from servoid.policy.diffusion.guidance import DenoisingStep, Guidance, Predictor
from servoid.policy.diffusion.schedule import DenoisingMatrix


@dataclass(frozen=True)
class Known:
    """Tokens that are given, normalised; the masks say which. What lies under False is not read.

    `impute` puts what is known of other states, some features of a token for one, into a predicted clean window.
    """

    states: Tensor  # (batch, state tokens, features)
    actions: Tensor  # (batch, action tokens, features)
    state_mask: Tensor  # (state tokens,) bool
    action_mask: Tensor  # (action tokens,) bool
    impute: Callable[[Tensor], Tensor] | None = None  # clean states to clean states


def draw_noise(generators: Sequence[torch.Generator], tokens: int, features: int) -> Tensor:
    """Noise `(batch, tokens, features)`, one generator a sample, so that a sample does not depend on its batch."""
    return torch.stack([torch.randn(tokens, features, generator=g) for g in generators])


@dataclass(frozen=True)
class _Call:
    """A network call: the levels that tokens are shown with, and the steps of states and actions after it."""

    levels: tuple[Tensor, Tensor]
    states: DenoisingStep
    actions: DenoisingStep
    guided: bool  # once all states are finished, guidance has nothing to move


class Sampler:
    """Walks a denoising matrix with a predictor of clean windows."""

    def __init__(self, predict: Predictor, signal: Array, eta: float = 0.0, stabilization_level: int = 0) -> None:
        """`signal` is the cumulative signal of each level (`schedule.cosine_signal`).

        `eta` 0 is DDIM and 1 is DDPM. Tokens that are clean, the past among them, are shown to the network as if they
        were at level `stabilization_level`, with their values untouched (UniPhys, algorithm 1, line 5).
        """
        self._predict = predict
        self._walk = _Walk(np.asarray(signal, dtype=float).tobytes(), eta, stabilization_level)
        self._eta = eta

    def sample(
        self,
        matrix: DenoisingMatrix,
        known: Known,
        generators: Sequence[torch.Generator],
        guidance: Guidance | None = None,
        start: tuple[Tensor, Tensor] | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Clean states and actions, shaped like `known`; all randomness comes from `generators`, one a sample.

        Sampling begins with pure noise, or with the noisy states and actions `start` at the levels of the matrix's
        first row. Raises Diverged.
        """
        if start is None:
            start = draw_noise(generators, *known.states.shape[1:]), draw_noise(generators, *known.actions.shape[1:])
        masks = known.state_mask.numpy(), known.action_mask.numpy()
        states, actions = (
            np.where(mask[:, None], given.numpy(), noisy.numpy())
            for mask, given, noisy in zip(masks, (known.states, known.actions), start, strict=True)
        )
        for call in _calls(self._walk, *(x.tobytes() for x in (matrix.states, matrix.actions, *masks)), matrix.calls):
            window = torch.from_numpy(states), torch.from_numpy(actions)
            if guidance is None or not call.guided:
                clean_states, clean_actions = (x.numpy() for x in self._predict(*window, *call.levels))
            else:
                clean_states, clean_actions = guidance.predict(
                    self._predict, *window, call.levels, call.states, call.actions.moving
                )
            if known.impute is not None:
                clean_states = known.impute(torch.from_numpy(clean_states)).numpy()
            states = self._step(states, clean_states, call.states, generators)
            actions = self._step(actions, clean_actions, call.actions, generators)
        return torch.from_numpy(states), torch.from_numpy(actions)

    def _step(self, noisy: Array, clean: Array, step: DenoisingStep, generators: Sequence[torch.Generator]) -> Array:
        """Tokens after a call that predicted them `clean`."""
        stepped: Array = step.of_clean * clean
        stepped += step.of_noisy * noisy
        if self._eta:
            stepped += step.fresh * draw_noise(generators, *noisy.shape[1:]).numpy()
        return stepped


@dataclass(frozen=True)
class _Walk:
    """What steps depend on besides the matrix."""

    signal: bytes  # float64, by level
    eta: float
    stabilization_level: int


@lru_cache(maxsize=64)  # plan after plan walks the same matrix
def _calls(
    walk: _Walk, states: bytes, actions: bytes, state_mask: bytes, action_mask: bytes, count: int
) -> list[_Call]:
    """The `count` calls of a matrix whose known tokens stay clean. Its rows are int64, masks bool."""
    parts = []
    for rows, mask in ((states, state_mask), (actions, action_mask)):
        levels = np.frombuffer(rows, dtype=np.int64).reshape(count + 1, -1)
        parts.append(np.where(np.frombuffer(mask, dtype=bool), 0, levels))
    shown = [torch.from_numpy(np.where(levels == 0, walk.stabilization_level, levels)) for levels in parts]
    steps = [_steps(levels, np.frombuffer(walk.signal), walk.eta) for levels in parts]
    return [
        _Call((state_levels, action_levels), of_states, of_actions, bool(of_states.moving.any()))
        for state_levels, action_levels, of_states, of_actions in zip(shown[0], shown[1], *steps, strict=False)
    ]


def _steps(levels: Array, signal: Array, eta: float) -> list[DenoisingStep]:
    """Steps between rows of `levels` `(calls + 1, tokens)`; `signal` by level.

    With a and b the signal before and after, the noise in a token is e = (x - sqrt(a) x0) / sqrt(1 - a), and it goes to
    sqrt(b) x0 + sqrt(1 - b - v) e + sqrt(v) noise, where v = eta^2 (1 - b) / (1 - a) (1 - a / b).
    """
    a, b = signal[levels[:-1]][..., None], signal[levels[1:]][..., None]
    moving = levels[1:] < levels[:-1]
    noise = np.sqrt(np.maximum(1 - a, 1e-12))
    fresh = eta**2 * (1 - b) / noise**2 * (1 - a / b)
    kept = np.sqrt(np.maximum(1 - b - fresh, 0.0)) / noise
    moves = moving[..., None]
    factors = (
        np.where(moves, np.sqrt(b) - kept * np.sqrt(a), 0.0),
        np.where(moves, kept, 1.0),
        np.where(moves, np.sqrt(np.maximum(fresh, 0.0)), 0.0),
        np.sqrt(a),
        noise,
    )
    return [DenoisingStep(*parts) for parts in zip(moving, *(x.astype(np.float32) for x in factors), strict=True)]

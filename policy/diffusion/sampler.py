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


class Sampler:
    """Walks a denoising matrix with a predictor of clean windows."""

    def __init__(self, predict: Predictor, signal: Array, eta: float = 0.0, stabilization_level: int = 0) -> None:
        """`signal` is the cumulative signal of each level (`schedule.cosine_signal`).

        `eta` 0 is DDIM and 1 is DDPM. Tokens that are clean, the past among them, are shown to the network as if they
        were at level `stabilization_level`, with their values untouched (UniPhys, algorithm 1, line 5).
        """
        self._predict = predict
        self._levels = signal.astype(np.float32).tobytes()
        self._eta = eta
        self._stabilization_level = stabilization_level

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
        matrix = matrix.hold(known.state_mask.numpy(), known.action_mask.numpy())
        rows = matrix.states, matrix.actions
        state_rows, action_rows = (torch.as_tensor(x) for x in rows)
        if start is None:
            start = draw_noise(generators, *known.states.shape[1:]), draw_noise(generators, *known.actions.shape[1:])
        states = torch.where(known.state_mask[:, None], known.states, start[0])
        actions = torch.where(known.action_mask[:, None], known.actions, start[1])
        state_steps, action_steps = (_steps(x.tobytes(), x.shape, self._levels, self._eta) for x in rows)
        shown = [rows.masked_fill(rows == 0, self._stabilization_level) for rows in (state_rows, action_rows)]
        for call, (of_states, of_actions) in enumerate(zip(state_steps, action_steps, strict=True)):
            # Once all states are finished, guidance has nothing to move.
            steering = guidance if of_states.moving.any() else None
            levels = shown[0][call], shown[1][call]
            if steering is None:
                clean_states, clean_actions = self._predict(states, actions, *levels)
            else:
                clean_states, clean_actions = steering.predict(self._predict, states, actions, levels, of_states)
            if known.impute is not None:
                clean_states = known.impute(clean_states)
            states = self._step(states, clean_states, of_states, generators)
            actions = self._step(actions, clean_actions, of_actions, generators)
        return states, actions

    def _step(self, noisy: Tensor, clean: Tensor, step: DenoisingStep, generators: Sequence[torch.Generator]) -> Tensor:
        """Tokens after a call that predicted them `clean`."""
        noise = (noisy - step.signal_before * clean) / step.noise_before
        stepped = step.signal_after * clean + step.noise_after * noise
        if self._eta:
            stepped = stepped + step.noise_fresh * draw_noise(generators, *noisy.shape[1:])
        return torch.where(step.moving[:, None], stepped, noisy)


@lru_cache(maxsize=64)  # plan after plan walks the same matrix
def _steps(rows: bytes, shape: tuple[int, ...], signal: bytes, eta: float) -> list[DenoisingStep]:
    """Steps between rows of a denoising matrix of `shape` `(calls + 1, tokens)` int64; `signal` float32, by level."""
    levels = torch.from_numpy(np.frombuffer(rows, dtype=np.int64).reshape(shape).copy())
    kept = torch.from_numpy(np.frombuffer(signal, dtype=np.float32).copy())
    a, b = kept[levels[:-1]][..., None], kept[levels[1:]][..., None]
    fresh = eta**2 * (1 - b) / (1 - a).clamp_min(1e-6) * (1 - a / b)  # variance of the noise drawn anew
    factors = (
        a.sqrt(),
        (1 - a).sqrt().clamp_min(1e-6),
        b.sqrt(),
        (1 - b - fresh).clamp_min(0.0).sqrt(),
        fresh.clamp_min(0.0).sqrt(),
    )
    return [DenoisingStep(*parts) for parts in zip(levels[1:] < levels[:-1], *factors, strict=True)]

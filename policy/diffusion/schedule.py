"""Noise schedules and denoising matrices.

Level 0 is clean and level `levels` is pure noise. A token at level k holds

    x_k = sqrt(a_k) x_0 + sqrt(1 - a_k) noise

with `a` the cumulative signal (alpha bar). A denoising matrix says which level every token has before and after each
network call, so that full-sequence, autoregressive, pyramid and rolling sampling differ in an array only (the seam of
Diffusion Forcing, arXiv:2407.01392).
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from hw.hal import Array


def cosine_signal(levels: int, offset: float = 0.008) -> Array:
    """Cumulative signal `(levels + 1,)` of the cosine schedule, from 1 at level 0 to almost 0 at `levels`.

    Nichol and Dhariwal, arXiv:2102.09672, eq. 17; a single level never removes more than 99.9 % of the variance.
    """
    if levels < 1:
        raise ValueError(f"a noise schedule needs at least one level, not {levels}")
    angle = (np.arange(levels + 1) / levels + offset) / (1 + offset) * np.pi / 2
    signal = np.cos(angle) ** 2
    keep = np.maximum(signal[1:] / signal[:-1], 1e-3)
    return np.concatenate([[1.0], np.cumprod(keep)])


def ddim_levels(levels: int, steps: int) -> Array:
    """Integer levels `(steps + 1,)` visited by a DDIM sampler, evenly spaced from `levels` down to 0."""
    if not 1 <= steps <= levels:
        raise ValueError(f"the number of denoising steps must be 1 to {levels} (the training levels), not {steps}")
    return np.round(np.linspace(levels, 0, steps + 1)).astype(np.int64)


@dataclass(frozen=True)
class DenoisingMatrix:
    """Noise level of each token before the first network call (row 0) and after each call (the rows below)."""

    states: Array  # (calls + 1, state tokens) int
    actions: Array  # (calls + 1, action tokens) int

    def __post_init__(self) -> None:
        if len(self.states) != len(self.actions) or len(self.states) < 2:
            raise ValueError(
                f"a denoising matrix needs as many rows for states as for actions, two or more, "
                f"not {len(self.states)} and {len(self.actions)}"
            )
        for name, rows in (("states", self.states), ("actions", self.actions)):
            if rows.min() < 0 or (np.diff(rows, axis=0) > 0).any():
                raise ValueError(f"noise levels of {name} must be >= 0 and never rise from one call to the next")

    @property
    def calls(self) -> int:
        """Network calls that the sampler makes."""
        return len(self.states) - 1

    def hold(self, states: Array, actions: Array) -> DenoisingMatrix:
        """The same matrix with known tokens at level 0 throughout; masks `(state tokens,)`, `(action tokens,)` bool."""
        return DenoisingMatrix(np.where(states, 0, self.states), np.where(actions, 0, self.actions))


def full_sequence(levels: int, steps: int, state_tokens: int, action_tokens: int, lead: int = 0) -> DenoisingMatrix:
    """All tokens go down together, in `steps` calls.

    With `lead` > 0 the states finish that many calls before the actions, which then see the finished states, at the
    price of as many extra calls.
    """
    ladder = ddim_levels(levels, steps)
    states = np.concatenate([ladder, np.zeros(lead, dtype=np.int64)])
    actions = np.concatenate([np.full(lead, levels), ladder])
    return DenoisingMatrix(np.repeat(states[:, None], state_tokens, 1), np.repeat(actions[:, None], action_tokens, 1))

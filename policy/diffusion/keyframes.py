"""Inpainting of keyframes: states to come that are given, whole or in part (Diffuse-CLoC, section 4.4).

A keyframe that is given whole is a known token at noise level 0, which sets it apart from noisy ones. Of one that is
given in part, the known features replace those of every predicted clean window.
"""

from __future__ import annotations

from collections.abc import Callable

import numpy as np
import torch
from torch import Tensor

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Keyframes
from servoid.policy.features import Normaliser, raw_layout, to_tokens


def keyframe_tokens(keyframes: Keyframes, present: Array, n_joints: int) -> tuple[Array, Array]:
    """Ticks `(k,)` of keyframes, and their tokens `(batch, k, token size)` as seen from `present` `(batch, raw size)`.

    Features that are free are NaN. Raises ValueError for keyframes that make no sense.
    """
    ticks, rows = np.asarray(keyframes.ticks), np.asarray(keyframes.states, dtype=float)
    size = raw_layout(n_joints).size
    if ticks.ndim != 1 or rows.shape != (len(ticks), size):
        raise ValueError(
            f"keyframes: states are {rows.shape} for ticks of {ticks.shape}, (k, {size}) and (k,) are needed"
        )
    if len(ticks) and (ticks[0] < 1 or (np.diff(ticks) <= 0).any()):
        raise ValueError(f"keyframes: ticks must be at least 1 and rise, not {ticks.tolist()}")
    if np.isinf(rows).any():
        raise ValueError("keyframes: states must be finite, or NaN where they are free")
    x, y, _ = np.moveaxis(np.isnan(rows[:, raw_layout(n_joints).slice("displacement")]), -1, 0)
    if (x != y).any():  # turned into the present heading, one that is free would free the other
        raise ValueError(f"keyframes: x and y must both be given or both be free, at tick {ticks[x != y][0]}")
    rows = np.broadcast_to(rows, (len(present), *rows.shape))
    return ticks, to_tokens(rows, np.asarray(present, dtype=float), n_joints)


def imputation(states: Normaliser, index: Tensor, tokens: Tensor) -> Callable[[Tensor], Tensor]:
    """A function that puts `tokens` `(batch, k, token size)`, NaN where free, at `index` `(k,)` of clean states."""
    free, given = torch.isnan(tokens), torch.nan_to_num(tokens)

    def impute(clean: Tensor) -> Tensor:
        pinned = torch.where(free, states.decode(clean[:, index]), given)
        return clean.index_copy(1, index, states.encode(pinned))

    return impute

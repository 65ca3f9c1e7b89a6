"""The newest windows that a policy moved through: what judges it learns from them."""

from __future__ import annotations

import torch
from torch import Tensor

_KEPT = 200_000  # windows, as in the AMP of the SMP paper


class Memory:
    """Parts of windows, oldest first; the oldest are forgotten."""

    def __init__(self) -> None:
        self._parts: list[Tensor] = []

    def see(self, windows: Tensor) -> None:
        """Remember `(batch, frames, size)`."""
        self._parts.append(windows.clone())
        while sum(map(len, self._parts[1:])) >= _KEPT:
            del self._parts[0]

    @property
    def windows(self) -> Tensor:
        """All that is remembered `(n, frames, size)`."""
        return torch.cat(self._parts)

    @staticmethod
    def drawn(windows: Tensor, count: int, generator: torch.Generator) -> Tensor:
        """So many of them, with replacement."""
        return windows[torch.randint(len(windows), (count,), generator=generator)]

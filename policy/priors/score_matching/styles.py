"""Which style a window of motion shows: what tells whether a policy moves in the style that it was asked for.

It learns beside the prior, from the same windows, and shares nothing with it. Of the whole body, and of each half by
itself, since styles are composed of halves.
"""

from __future__ import annotations

from collections.abc import Mapping

import torch
from torch import Tensor, nn
from torch.nn import functional

from servoid.policy.priors.features import PriorFeatures
from servoid.policy.priors.score_matching.network import PriorConfig

PARTS = ("whole", "upper", "lower")
_HIDDEN = 96
_NOISE = 0.2  # deviations that are added while it learns: what a policy does is not quite what the data shows


class StyleClassifier(nn.Module):
    """Logits of styles by normalised windows `(batch, frames, size)`."""

    seen: Tensor  # (parts, size) 1 where a part looks

    def __init__(self, config: PriorConfig, features: PriorFeatures) -> None:
        super().__init__()
        lower = torch.from_numpy(features.lower)
        seen = torch.stack([torch.ones_like(lower), ~lower, lower]).float()
        self.register_buffer("seen", seen, persistent=False)
        inputs = config.frames * config.size
        self.parts = nn.ModuleList(
            nn.Sequential(nn.Linear(inputs, _HIDDEN), nn.ReLU(), nn.Linear(_HIDDEN, len(config.styles))) for _ in PARTS
        )

    def forward(self, windows: Tensor) -> Tensor:
        """`(parts, batch, styles)`."""
        return torch.stack(
            [part((windows * seen).flatten(1)) for part, seen in zip(self.parts, self.seen, strict=True)]
        )

    def loss(self, windows: Tensor, styles: Tensor, generator: torch.Generator) -> Tensor:
        """Cross entropy of the styles `(batch,)` that windows show, numbered from 1."""
        noise = torch.randn(windows.shape, generator=generator)
        logits = self(windows + _NOISE * noise).flatten(0, 1)
        return functional.cross_entropy(logits, (styles - 1).repeat(len(PARTS)))

    @torch.inference_mode()
    def told(self, windows: Tensor) -> Tensor:
        """The style that each part shows most, numbered from 1 `(parts, batch)`."""
        return self(windows).argmax(-1) + 1

    def shares(self, windows: Tensor, upper: int, lower: int) -> Mapping[str, float]:
        """Shares of normalised windows whose halves show these styles, numbered from 1, and whose whole does, where
        they are one style."""
        _, above, below = told = self.told(windows)
        found = {"upper_style": above == upper, "lower_style": below == lower}
        found["style"] = told[0] == upper if upper == lower else (above == upper) & (below == lower)
        return {name: float(hit.float().mean()) for name, hit in found.items()}

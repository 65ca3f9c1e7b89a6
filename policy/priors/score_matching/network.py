"""The denoiser of a motion prior: DiT blocks over the frames of a window, all at one noise level.

Peebles and Xie, arXiv:2212.09748: noise level and style shift, scale and gate what each block does (adaptive norm). As
SMP has it (section 6.2), it predicts the noise.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Any

import torch
from torch import Tensor, nn

from servoid.hw.config import ConfigError
from servoid.policy.diffusion.model.denoiser import Block


@dataclass(frozen=True)
class PriorConfig:
    """Shape of a prior. Stored in the checkpoint. Raises ConfigError for one that cannot be."""

    size: int  # features of a frame
    frames: int = 10  # of a window
    stride: int = 2  # ticks from one frame to the next
    layers: int = 2
    width: int = 64
    heads: int = 4
    levels: int = 50
    styles: tuple[str, ...] = ()

    def __post_init__(self) -> None:
        for name in ("size", "stride", "layers", "width", "heads", "levels"):
            if getattr(self, name) < 1:
                raise ConfigError(f"prior: {name} must be at least 1, not {getattr(self, name)}")
        if self.frames < 2:
            raise ConfigError(f"prior: frames must be at least 2, not {self.frames}: one shows no motion")
        if self.width % (2 * self.heads):
            raise ConfigError(f"prior: width {self.width} is not a multiple of twice heads {self.heads}")

    @classmethod
    def from_header(cls, config: Mapping[str, Any]) -> PriorConfig:
        """As a checkpoint stores it. Raises TypeError or ConfigError."""
        return cls(**{**config, "styles": tuple(config.get("styles", ()))})

    def style(self, name: str | None) -> int:
        """Number of a style, 0 for None. Raises ConfigError for one that the prior has not."""
        if name is None:
            return 0
        if name not in self.styles:
            known = ", ".join(self.styles) or "it was trained without styles"
            raise ConfigError(f"style '{name}': not in this prior; known: {known}")
        return 1 + self.styles.index(name)


def sinusoids(places: Tensor, width: int, longest: float) -> Tensor:
    """Sines and cosines `(places, width)` with periods from 2 to `longest`, evenly spaced in their logarithm."""
    periods = 2.0 * (longest / 2.0) ** torch.linspace(0.0, 1.0, width // 2)
    angle = 2.0 * torch.pi * places[:, None] / periods
    return torch.cat([angle.sin(), angle.cos()], -1)


class PriorNetwork(nn.Module):
    """Predicts the noise in normalised windows `(batch, frames, size)`."""

    places: Tensor
    mask: Tensor

    def __init__(self, config: PriorConfig) -> None:
        super().__init__()
        self.config, width = config, config.width
        self.embed = nn.Linear(config.size, width)
        self.level = nn.Embedding(config.levels + 1, width)
        self.style = nn.Embedding(1 + len(config.styles), width)
        self.blocks = nn.ModuleList(Block(width, config.heads) for _ in range(config.layers))
        self.norm = nn.LayerNorm(width)
        self.head = nn.Linear(width, config.size)
        # Shared by all blocks and the head: shifts, scales and gates, from which each block's own may differ.
        self.condition = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, 6 * width))
        self.own = nn.Parameter(torch.zeros(config.layers + 1, 6, width))
        self.register_buffer("places", sinusoids(torch.arange(config.frames), width, 40.0), persistent=False)
        self.register_buffer("mask", torch.ones(config.frames, config.frames, dtype=torch.bool), persistent=False)
        with torch.no_grad():
            self.level.weight.copy_(sinusoids(torch.arange(config.levels + 1), width, 4.0 * config.levels))
        nn.init.normal_(self.style.weight, std=0.02)
        last = self.condition[-1]
        assert isinstance(last, nn.Linear)
        nn.init.zeros_(last.weight)
        nn.init.zeros_(last.bias)
        nn.init.ones_(self.own[:, 2])  # gates begin open: two layers need no identity to start from
        nn.init.ones_(self.own[:, 5])

    def forward(self, windows: Tensor, levels: Tensor, styles: Tensor) -> Tensor:
        """`levels` and `styles` (0: none) are `(batch,)` integers."""
        modulation = self.condition(self.level(levels) + self.style(styles)).view(len(windows), 1, 6, -1)
        x = self.embed(windows) + self.places
        for block, own in zip(self.blocks, self.own, strict=False):
            x = block(x, self.mask, modulation + own)
        shift, scale = (modulation + self.own[-1])[:, :, :2].unbind(2)
        return self.head(self.norm(x) * (1.0 + scale) + shift)

    @property
    def parameter_count(self) -> int:
        return sum(p.numel() for p in self.parameters())

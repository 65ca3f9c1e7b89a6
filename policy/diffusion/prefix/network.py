"""The planner's network (DiP): a transformer decoder over clean frames so far and noisy ones to come.

Sentence, target and denoising step reach every layer by cross-attention: a token a word, and one for step and target
together. It predicts the clean frames (x0).
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn

from servoid.policy.diffusion.model.denoiser import Block, tick_encoding
from servoid.policy.diffusion.prefix.config import PlannerConfig

_BEGINS = 20  # place of the first frame to come, whatever the prefix: a network learns on with a longer or shorter one


class CrossAttention(nn.Module):
    """Pre-norm attention of the frames to the conditions."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.norm = nn.LayerNorm(width)
        self.attention = nn.MultiheadAttention(width, heads, batch_first=True)

    def forward(self, x: Tensor, memory: Tensor, missing: Tensor) -> Tensor:
        """Tokens `(batch, tokens, width)` to the same; `missing` `(batch, conditions)` bool are not attended to."""
        attended, _ = self.attention(self.norm(x), memory, memory, key_padding_mask=missing, need_weights=False)
        return x + attended


class PlannerNetwork(nn.Module):
    """Predicts the frames to come. Inputs and outputs are normalised.

    A layer attends to the conditions first and then to the frames, with the core's own block; in a stack that is the
    usual decoder but for where it begins.
    """

    mask: Tensor
    places: Tensor
    word_places: Tensor

    def __init__(self, config: PlannerConfig) -> None:
        super().__init__()
        self.config = config
        width, tokens = config.width, config.prefix + config.frames
        self.embed = nn.Linear(config.size, width)
        self.place = nn.Linear(width, width)
        self.embed_word = nn.Linear(config.text_size, width)
        self.embed_level = nn.Sequential(nn.Linear(width, width), nn.SiLU(), nn.Linear(width, width))
        self.embed_target = nn.Sequential(nn.Linear(config.target_size, width), nn.SiLU(), nn.Linear(width, width))
        self.cross = nn.ModuleList(CrossAttention(width, config.heads) for _ in range(config.layers))
        self.blocks = nn.ModuleList(Block(width, config.heads) for _ in range(config.layers))
        self.norm = nn.LayerNorm(width)
        self.head = nn.Linear(width, config.size)
        self.register_buffer("mask", torch.ones(tokens, tokens, dtype=torch.bool), persistent=False)
        places = np.arange(tokens) - config.prefix + _BEGINS
        self.register_buffer("places", tick_encoding(places, width), persistent=False)
        self.register_buffer("word_places", tick_encoding(np.arange(config.words), width), persistent=False)
        self.register_buffer("levels", tick_encoding(np.arange(config.levels + 1), width, 4.0 * config.levels))

    def forward(
        self, frames: Tensor, level: Tensor, target: Tensor, text: Tensor, text_mask: Tensor | None = None
    ) -> Tensor:
        """Clean frames to come `(batch, frames, size)`.

        `frames` `(batch, prefix + frames, size)`, the prefix clean and the others at noise level `level` `(batch,)`
        int; `target` `(batch, target_size)` is an encoded one; `text` `(batch, words, text_size)` has NaN where there
        is no word; `text_mask` `(batch,)` bool says which of a batch are told it.
        """
        x = self.embed(frames) + self.place(self.places)
        missing = text.isnan().any(-1)
        if text_mask is not None:
            missing = missing | ~text_mask[:, None]
        words = self.embed_word(text.nan_to_num()) + self.word_places[: text.shape[1]]
        levels: Tensor = self.get_buffer("levels")
        step = self.embed_level(levels[level]) + self.embed_target(target)
        memory = torch.cat([words, step[:, None]], 1)
        missing = torch.cat([missing, missing.new_zeros(len(missing), 1)], 1)
        for cross, block in zip(self.cross, self.blocks, strict=True):
            x = block(cross(x, memory, missing), self.mask)
        clean: Tensor = self.head(self.norm(x[:, self.config.prefix :]))
        return clean

    @property
    def parameter_count(self) -> int:
        return sum(p.numel() for p in self.parameters())

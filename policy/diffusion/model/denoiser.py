"""The denoiser: one transformer over state and action tokens, each with its own noise level.

Tokens of a window around the present tick 0, with `history` ticks known and `horizon` to come:

    states   -history+1 .. 0 (past and present), 1 .. horizon, or some of them: `DenoiserConfig.ticks`
    actions  -history+1 .. -1 (past), 0 .. horizon-1, or fewer: `DenoiserConfig.actions`

An action of tick t is decided on the state of tick t and leads to the state of tick t + 1.
"""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor, nn
from torch.nn import functional

from servoid.hw.contracts.body import Array
from servoid.policy.diffusion.model.config import DenoiserConfig
from servoid.policy.diffusion.model.masks import attention_mask


def _attend(q: Tensor, k: Tensor, v: Tensor, mask: Tensor) -> Tensor:
    """Masked attention over `(batch, heads, tokens, head width)`."""
    if not torch.is_grad_enabled():
        return functional.scaled_dot_product_attention(q, k, v, attn_mask=mask)
    # With a mask, the backward pass of the fused kernel takes 40 % of a training step on a CPU; this takes 5 %.
    scores = (q * q.shape[-1] ** -0.5) @ k.transpose(-1, -2)
    return scores.masked_fill(~mask, float("-inf")).softmax(-1).to(v.dtype) @ v


class Block(nn.Module):
    """Pre-norm attention and feed-forward."""

    def __init__(self, width: int, heads: int) -> None:
        super().__init__()
        self.heads = heads
        self.norm_attention = nn.LayerNorm(width)
        self.qkv = nn.Linear(width, 3 * width)
        self.out = nn.Linear(width, width)
        self.norm_feed = nn.LayerNorm(width)
        self.feed = nn.Sequential(nn.Linear(width, 4 * width), nn.GELU(), nn.Linear(4 * width, width))

    def forward(self, x: Tensor, mask: Tensor, modulation: Tensor | None = None) -> Tensor:
        """Tokens `(batch, tokens, width)` to the same; `mask` is `(tokens, tokens)` bool.

        `modulation` `(batch, 1 or tokens, 6, width)` makes the norms adaptive: shift, scale and gate of the attention,
        then of the feed-forward (Peebles and Xie, arXiv:2212.09748).
        """
        if modulation is None:
            x = x + self._attention(self.norm_attention(x), mask)
            return x + self.feed(self.norm_feed(x))
        shift, scale, gate, feed_shift, feed_scale, feed_gate = modulation.unbind(2)
        x = x + gate * self._attention(self.norm_attention(x) * (1.0 + scale) + shift, mask)
        return x + feed_gate * self.feed(self.norm_feed(x) * (1.0 + feed_scale) + feed_shift)

    def _attention(self, x: Tensor, mask: Tensor) -> Tensor:
        batch, tokens, width = x.shape
        qkv = self.qkv(x).view(batch, tokens, 3, self.heads, width // self.heads)
        q, k, v = qkv.permute(2, 0, 3, 1, 4).unbind(0)
        return self.out(_attend(q, k, v, mask).transpose(1, 2).reshape(batch, tokens, width))


def tick_encoding(ticks: Array, width: int, slowest: float = 400.0) -> Tensor:
    """Sines and cosines `(ticks, width)` of ticks, with periods from 2 to `slowest` ticks in even ratios.

    Ticks far apart differ at once, where positions learned from small random numbers take long to come apart.
    """
    periods = np.geomspace(2.0, slowest, width // 2)
    angles = 2.0 * np.pi * ticks[:, None] / periods
    waves = np.concatenate([np.sin(angles), np.cos(angles), np.zeros((len(ticks), width % 2))], axis=1)
    return torch.from_numpy(waves).float()


class Denoiser(nn.Module):
    """Predicts the clean window (x0) from a noisy one. Inputs and outputs are normalised."""

    mask: Tensor
    state_places: Tensor
    action_places: Tensor

    def __init__(self, config: DenoiserConfig) -> None:
        super().__init__()
        self.config = config
        width = config.width
        # States pass through an MLP and actions through a linear layer, as in Diffuse-CLoC.
        self.embed_state = nn.Sequential(nn.Linear(config.state_size, width), nn.GELU(), nn.Linear(width, width))
        self.embed_action = nn.Linear(config.action_size, width)
        self.level = nn.Embedding(config.levels + 1, width)
        if config.ticks:
            self.place = nn.Linear(width, width)
            for name, ticks in (("state_places", config.state_ticks), ("action_places", config.action_ticks)):
                self.register_buffer(name, tick_encoding(ticks, width), persistent=False)
        else:
            self.position = nn.Parameter(0.02 * torch.randn(config.history + config.horizon, width))
        self.kind = nn.Parameter(0.02 * torch.randn(2, width))
        if config.text_size:
            # There is one instruction for all tokens, so width costs little: skills and their times are many.
            hidden = 4 * width if config.clock else width
            self.embed_text = nn.Sequential(nn.Linear(config.text_size, hidden), nn.GELU(), nn.Linear(hidden, width))
            self.no_text = nn.Parameter(torch.zeros(width))
        self.blocks = nn.ModuleList(Block(width, config.heads) for _ in range(config.layers))
        self.norm = nn.LayerNorm(width)
        self.head_state = nn.Linear(width, config.state_size)
        self.head_action = nn.Linear(width, config.action_size)
        nn.init.normal_(self.level.weight, std=0.02)
        mask = attention_mask(config.mask, config.state_ticks, config.action_ticks)
        self.register_buffer("mask", torch.from_numpy(mask), persistent=False)

    def forward(
        self,
        states: Tensor,
        actions: Tensor,
        state_levels: Tensor,
        action_levels: Tensor,
        text: Tensor | None = None,
        text_mask: Tensor | None = None,
    ) -> tuple[Tensor, Tensor]:
        """Clean states and actions predicted from noisy ones.

        Shapes `(batch, state tokens, state_size)`, `(batch, action tokens, action_size)`; levels are integers
        `(batch, tokens)`, or `(tokens,)` when the batch shares them. `text` `(batch, text_size)` is the encoded
        instruction, None for a window without one; `text_mask` `(batch,)` bool says which windows of a batch have one.
        """
        n = states.shape[1]
        x = self.joined(self.embed_state(states), actions, state_levels, action_levels, text, text_mask)
        for block in self.blocks:
            x = block(x, self.mask)
        x = self.norm(x)
        return self.head_state(x[:, :n]), self.head_action(x[:, n:])

    def joined(
        self,
        embedded: Tensor,
        actions: Tensor,
        state_levels: Tensor,
        action_levels: Tensor,
        text: Tensor | None,
        text_mask: Tensor | None,
    ) -> Tensor:
        """Tokens `(batch, tokens, width)` that the blocks begin with, of states that are `embedded` already."""
        state_place, action_place = self._places(actions.shape[1])
        at_state = embedded + self.level(state_levels) + state_place + self.kind[0]
        at_action = self.embed_action(actions) + self.level(action_levels) + action_place + self.kind[1]
        x = torch.cat([at_state, at_action], 1)
        return x + self._instruction(text, text_mask) if self.config.text_size else x

    def _places(self, actions: int) -> tuple[Tensor, Tensor]:
        """What says at which tick a token is, `(tokens, width)` of states and of `actions` actions."""
        if self.config.ticks:
            return self.place(self.state_places), self.place(self.action_places)
        return self.position, self.position[:actions]

    def _instruction(self, text: Tensor | None, text_mask: Tensor | None) -> Tensor:
        """What is added to every token: `(batch, 1, width)` or, without an instruction, `(width,)`."""
        if text is None:
            return self.no_text
        embedded = self.embed_text(text)
        if text_mask is not None:
            embedded = torch.where(text_mask[:, None], embedded, self.no_text)
        return embedded[:, None]

    @property
    def parameter_count(self) -> int:
        return sum(p.numel() for p in self.parameters())

"""The way back through a denoiser, written out: the gradient on noisy states of what is pulled at the clean ones.

Autograd does the same for all tokens and remembers each operation. Here the forward pass gives what the way back needs,
and where states see no action, as in Diffuse-CLoC, the way back is about states alone. Both passes are plain functions
of tensors, so that they can be exported as graphs for engines that have no autograd.
"""

from __future__ import annotations

import math

import torch
from torch import Tensor, nn
from torch.nn import functional

from servoid.policy.diffusion.model.denoiser import Block, Denoiser

_PER_BLOCK = 5  # tensors that are kept of each block


def kept_names(denoiser: Denoiser) -> list[str]:
    """Names of what `Forward` gives beside its prediction, in order."""
    parts = [f"{part}_{i}" for i in range(len(denoiser.blocks)) for part in ("entered", "qkv", "seen", "fed", "feed")]
    return ["embedded", *parts, "left"]


def reached(denoiser: Denoiser) -> int:
    """How many tokens, from the first, clean states depend on: states alone where these see no action."""
    states = len(denoiser.config.state_ticks)
    return len(denoiser.mask) if bool(denoiser.mask[:states, states:].any()) else states


class Forward(nn.Module):
    """What a denoiser predicts, and what `Backward` needs of how: see `kept_names`."""

    def __init__(self, denoiser: Denoiser) -> None:
        super().__init__()
        self.denoiser = denoiser
        self.tokens = reached(denoiser)

    def forward(
        self,
        states: Tensor,
        actions: Tensor,
        state_levels: Tensor,
        action_levels: Tensor,
        text: Tensor | None = None,
        text_mask: Tensor | None = None,
    ) -> tuple[Tensor, ...]:
        """Clean states and actions as `Denoiser.forward` gives them, and the tensors to keep."""
        net, n, until = self.denoiser, states.shape[1], self.tokens
        first, gelu, second = net.embed_state
        embedded = first(states)
        x = net.joined(second(gelu(embedded)), actions, state_levels, action_levels, text, text_mask)
        kept = [embedded]
        for block in net.blocks:
            assert isinstance(block, Block)
            entered = x
            qkv, seen, attended = _attention(block, x, net.mask)
            x = fed = x + attended
            feed = block.feed[0](block.norm_feed(x))
            x = x + block.feed[2](functional.gelu(feed))
            kept += [entered[:, :until], qkv[:, :until], seen[..., :until, :until], fed[:, :until], feed[:, :until]]
        last = net.norm(x)
        return net.head_state(last[:, :n]), net.head_action(last[:, n:]), *kept, x[:, :until]


def _attention(block: Block, x: Tensor, mask: Tensor) -> tuple[Tensor, Tensor, Tensor]:
    """Queries, keys and values `(batch, tokens, 3, heads, head width)`, what each sees of each, and what is added."""
    batch, tokens, width = x.shape
    qkv = block.qkv(block.norm_attention(x)).view(batch, tokens, 3, block.heads, width // block.heads)
    q, k, v = qkv.permute(2, 0, 3, 1, 4).unbind(0)
    scores = (q * q.shape[-1] ** -0.5) @ k.transpose(-1, -2)
    seen = scores.masked_fill(~mask, float("-inf")).softmax(-1)
    return qkv, seen, block.out((seen @ v).transpose(1, 2).reshape(batch, tokens, width))


class Backward(nn.Module):
    """The gradient on noisy states, from that on clean states and what `Forward` kept."""

    def __init__(self, denoiser: Denoiser) -> None:
        super().__init__()
        self.denoiser = denoiser
        self.tokens = reached(denoiser)

    def forward(self, pull: Tensor, *kept: Tensor) -> Tensor:
        """`pull` and the gradient are `(batch, state tokens, state_size)`."""
        net, n = self.denoiser, pull.shape[1]
        embedded, *parts, left = kept
        slope = pull @ net.head_state.weight
        if self.tokens > n:
            slope = functional.pad(slope, (0, 0, 0, self.tokens - n))
        slope = _norm_back(net.norm, slope, left)
        for i in reversed(range(len(net.blocks))):
            block = net.blocks[i]
            assert isinstance(block, Block)
            entered, qkv, seen, fed, feed = parts[_PER_BLOCK * i : _PER_BLOCK * (i + 1)]
            widen, narrow = _weights(block.feed)
            slope = slope + _norm_back(block.norm_feed, ((slope @ narrow) * _gelu_slope(feed)) @ widen, fed)
            back = _attention_back(block, slope, qkv, seen)
            slope = slope + _norm_back(block.norm_attention, back @ block.qkv.weight, entered)
        first, second = _weights(net.embed_state)
        return ((slope[:, :n] @ second) * _gelu_slope(embedded)) @ first


def _weights(layers: nn.Sequential) -> tuple[Tensor, Tensor]:
    """Of two linear layers with a GELU between them."""
    first, _, second = layers
    assert isinstance(first, nn.Linear)
    assert isinstance(second, nn.Linear)
    return first.weight, second.weight


def _attention_back(block: Block, slope: Tensor, qkv: Tensor, seen: Tensor) -> Tensor:
    """The gradient `(batch, tokens, 3 width)` on queries, keys and values of that on what the attention adds."""
    batch, tokens, width = slope.shape
    q, k, v = qkv.permute(2, 0, 3, 1, 4).unbind(0)
    out = (slope @ block.out.weight).view(batch, tokens, block.heads, width // block.heads).transpose(1, 2)
    by_seen = out @ v.transpose(-1, -2)
    by_score = seen * (by_seen - (by_seen * seen).sum(-1, keepdim=True)) * q.shape[-1] ** -0.5
    parts = by_score @ k, by_score.transpose(-1, -2) @ q, seen.transpose(-1, -2) @ out
    return torch.stack(parts, 2).permute(0, 3, 2, 1, 4).reshape(batch, tokens, 3 * width)


def _norm_back(norm: nn.LayerNorm, slope: Tensor, x: Tensor) -> Tensor:
    """The gradient on what a norm was given, of that on what it gave."""
    centred = x - x.mean(-1, keepdim=True)
    scale = (centred.square().mean(-1, keepdim=True) + norm.eps).rsqrt()
    normal, slope = centred * scale, slope * norm.weight
    return scale * (slope - slope.mean(-1, keepdim=True) - normal * (slope * normal).mean(-1, keepdim=True))


def _gelu_slope(x: Tensor) -> Tensor:
    """With the normal distribution's integral and density: P(x) + x p(x)."""
    return 0.5 * (1.0 + torch.erf(x * 0.5**0.5)) + x * torch.exp(-0.5 * x.square()) / math.sqrt(2.0 * math.pi)

"""The training objective of the diffusion core: noise levels, loss, and the averaged weights that are shipped."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from policy.diffusion.config import DenoiserConfig
from policy.diffusion.denoiser import Denoiser

UNTOLD = 0.1  # share of windows without an instruction


def draw_levels(
    config: DenoiserConfig, batch: int, committed: int, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Noise levels `(batch, state tokens)` and `(batch, action tokens)`.

    Half of the windows have independent levels, clean included; the others share one, as they do when a plan is
    sampled. There the first 0 to `committed` actions to come are clean: they run while a plan is being made. The past
    is clean but in half of the windows with independent levels, which learn to mend one (UniPhys, section 3.2).
    """
    half = batch // 2
    n_states, n_actions, k = len(config.state_ticks), len(config.action_ticks), config.levels
    levels = torch.randint(k + 1, (batch, n_states + n_actions), generator=generator)
    levels[:half] = torch.randint(1, k + 1, (half, 1), generator=generator)
    states, actions = levels[:, :n_states], levels[:, n_states:]
    state_ticks, action_ticks = torch.from_numpy(config.state_ticks), torch.from_numpy(config.action_ticks)
    clean = torch.zeros(batch, 1, dtype=torch.long)
    clean[:half] = torch.randint(committed + 1, (half, 1), generator=generator)
    known = torch.arange(batch)[:, None] < half + (batch - half) // 2
    states = torch.where((state_ticks <= 0) & known, 0, states)
    actions = torch.where((action_ticks < clean) & known, 0, actions)
    return states, actions


def add_noise(x: Tensor, levels: Tensor, signal: Tensor, generator: torch.Generator) -> Tensor:
    """Tokens `(batch, tokens, features)` at `levels` `(batch, tokens)`."""
    a = signal[levels][..., None]
    return a.sqrt() * x + (1 - a).sqrt() * torch.randn(x.shape, generator=generator)


def token_error(predicted: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Weighted mean over tokens of the squared error; `weight` is `(batch, tokens)` or `(tokens,)`."""
    error = (predicted.float() - target).square().mean(-1)
    weight = weight.expand_as(error)
    return (error * weight).sum() / weight.sum().clamp_min(1e-9)


def action_weight(config: DenoiserConfig, near: int = 8, far_weight: float = 0.2) -> Tensor:
    """Loss weight of action tokens: 1 for the next `near` ticks, `far_weight` beyond, where they are uncertain."""
    ticks = torch.from_numpy(config.action_ticks)
    return torch.where(ticks < near, 1.0, far_weight) * (ticks >= 0)


def losses(
    denoiser: Denoiser,
    states: Tensor,
    actions: Tensor,
    text: Tensor | None,
    signal: Tensor,
    committed: int,
    generator: torch.Generator,
) -> tuple[Tensor, Tensor]:
    """State and action losses of a batch of clean windows: squared error of the predicted clean tokens (x0).

    One window in ten is shown without its instruction `text` `(batch, text_size)`, for classifier-free guidance.
    """
    config = denoiser.config
    state_levels, action_levels = draw_levels(config, len(states), committed, generator)
    noisy_states = add_noise(states, state_levels, signal, generator)
    noisy_actions = add_noise(actions, action_levels, signal, generator)
    told = torch.rand(len(states), generator=generator) >= UNTOLD
    clean_states, clean_actions = denoiser(noisy_states, noisy_actions, state_levels, action_levels, text, told)
    return (
        token_error(clean_states, states, (state_levels > 0).float()),
        token_error(clean_actions, actions, (action_levels > 0) * action_weight(config)),
    )


class Average:
    """Exponential moving average of a network's parameters, quick at first (warm-up)."""

    def __init__(self, network: nn.Module, decay: float = 0.999) -> None:
        self.decay = decay
        self.updates = 0
        self.weights = {name: p.detach().clone() for name, p in network.named_parameters()}

    @torch.no_grad()
    def update(self, network: nn.Module) -> None:
        self.updates += 1
        decay = min(self.decay, (1 + self.updates) / (10 + self.updates))
        for name, parameter in network.named_parameters():
            self.weights[name].lerp_(parameter, 1 - decay)

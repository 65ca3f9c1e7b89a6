"""The training objective of the diffusion core: noise levels, loss, and the averaged weights that are shipped."""

from __future__ import annotations

import torch
from torch import Tensor, nn

from servoid.policy.diffusion.model.config import TOGETHER, DenoiserConfig, TrainingObjective
from servoid.policy.diffusion.model.denoiser import Denoiser

UNTOLD = 0.1  # share of windows without an instruction


def draw_levels(
    config: DenoiserConfig, batch: int, generator: torch.Generator, objective: TrainingObjective
) -> tuple[Tensor, Tensor]:
    """Noise levels `(batch, state tokens)` and `(batch, action tokens)`.

    A share `forcing` of the windows has independent levels, clean included, and a noisy past, which they learn to mend
    (UniPhys, section 4.2). Of the others, which know their past, a third has independent levels of what is to come, and
    two thirds share one level, as they do when a plan is sampled; of these, a share `monotone` of all windows has
    levels that rise along the window instead. In those two thirds the first 0 to `inference_delay` actions to come are
    clean: they run while a plan is being made.
    """
    forced = round(objective.forcing * batch)
    together = round(TOGETHER * (batch - forced))
    n_states, n_actions, k = len(config.state_ticks), len(config.action_ticks), config.levels
    levels = torch.randint(k + 1, (batch, n_states + n_actions), generator=generator)
    levels[:together] = torch.randint(1, k + 1, (together, 1), generator=generator)
    if rising := min(round(objective.monotone * batch), together):
        levels[:rising] = torch.cat(rising_levels(config, rising, generator), 1)
    states, actions = levels[:, :n_states], levels[:, n_states:]
    state_ticks, action_ticks = torch.from_numpy(config.state_ticks), torch.from_numpy(config.action_ticks)
    clean = torch.zeros(batch, 1, dtype=torch.long)
    clean[:together] = torch.randint(objective.inference_delay + 1, (together, 1), generator=generator)
    known = torch.arange(batch)[:, None] < batch - forced
    states = torch.where((state_ticks <= 0) & known, 0, states)
    actions = torch.where((action_ticks < clean) & known, 0, actions)
    return states, actions


def rising_levels(config: DenoiserConfig, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
    """Levels that rise along the frames of a window: from a gentle slope (pyramid, rolling) to a step (autoregressive).

    In half of the windows actions are ahead of the states of their frame, or behind them, by some levels: when rolling,
    or with a lead, they are not denoised together.
    """

    def uniform(low: Tensor | float, high: float) -> Tensor:
        return low + (high - low) * torch.rand(batch, 1, generator=generator)

    k, last = config.levels, config.horizon - 1
    slope = k / (2 * config.horizon) * (4.0 * config.horizon) ** uniform(0.0, 1.0)  # levels a frame: a ramp to a step
    first = uniform(-slope * last, k)
    behind = uniform(-k, k) * (uniform(0.0, 1.0) < 0.5)
    frames = torch.from_numpy(config.state_ticks - 1), torch.from_numpy(config.action_ticks)
    states, actions = (first + slope * x for x in frames)
    return states.round().clamp(0, k).long(), (actions + behind).round().clamp(0, k).long()


def add_noise(x: Tensor, levels: Tensor, signal: Tensor, generator: torch.Generator) -> Tensor:
    """Tokens `(batch, tokens, features)` at `levels` `(batch, tokens)`."""
    a = signal[levels][..., None]
    return a.sqrt() * x + (1 - a).sqrt() * torch.randn(x.shape, generator=generator)


def token_error(predicted: Tensor, target: Tensor, weight: Tensor) -> Tensor:
    """Weighted mean over tokens of the squared error; `weight` is `(batch, tokens)` or `(tokens,)`."""
    error = (predicted.float() - target).square().mean(-1)
    weight = weight.expand_as(error)
    return (error * weight).sum() / weight.sum().clamp_min(1e-9)


def action_weight(config: DenoiserConfig, near: int, far_weight: float) -> Tensor:
    """Loss weight of action tokens: 1 for the next `near` ticks, `far_weight` beyond, where they are uncertain."""
    ticks = torch.from_numpy(config.action_ticks)
    return torch.where(ticks < near, 1.0, far_weight) * (ticks >= 0)


def level_weight(levels: Tensor, signal: Tensor, min_snr: float) -> Tensor:
    """Loss weight of tokens by their level: 0 for clean ones; min(SNR, `min_snr`) of the others, or 1 without a clip.

    Hang et al., arXiv:2303.09556, for a network that predicts x0.
    """
    noisy = (levels > 0).float()
    if not min_snr:
        return noisy
    a = signal[levels]
    return noisy * (a / (1 - a).clamp_min(1e-9)).clamp_max(min_snr)


def rate_error(predicted: Tensor, target: Tensor, levels: Tensor, weight: Tensor) -> Tensor:
    """Weighted mean of the squared error of the change from each action to the next; clean actions are as given.

    Shapes as in `token_error`; `weight` is that of the later action of a pair.
    """
    predicted = torch.where((levels > 0)[..., None], predicted.float(), target)
    return token_error(predicted.diff(dim=1), target.diff(dim=1), weight[..., 1:])


def losses(
    denoiser: Denoiser,
    states: Tensor,
    actions: Tensor,
    text: Tensor | None,
    signal: Tensor,
    generator: torch.Generator,
    objective: TrainingObjective,
) -> tuple[Tensor, Tensor]:
    """State and action losses of a batch of clean windows: squared error of the predicted clean tokens (x0).

    One window in ten is shown without its instruction `text` `(batch, text_size)`, for classifier-free guidance.
    """
    config = denoiser.config
    state_levels, action_levels = draw_levels(config, len(states), generator, objective)
    noisy_states = add_noise(states, state_levels, signal, generator)
    noisy_actions = add_noise(actions, action_levels, signal, generator)
    text_mask = torch.rand(len(states), generator=generator) >= UNTOLD
    clean_states, clean_actions = denoiser(noisy_states, noisy_actions, state_levels, action_levels, text, text_mask)
    state_weight, weight = (level_weight(x, signal, objective.min_snr) for x in (state_levels, action_levels))
    weight = weight * action_weight(config, objective.near_actions, objective.far_actions)
    action_loss = token_error(clean_actions, actions, weight)
    if objective.action_rate:
        action_loss = action_loss + objective.action_rate * rate_error(clean_actions, actions, action_levels, weight)
    return token_error(clean_states, states, state_weight), action_loss


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

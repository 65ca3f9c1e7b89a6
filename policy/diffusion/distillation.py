"""Progressive distillation: a network that learns to take in one step what its teacher takes in two.

Salimans and Ho, arXiv:2202.00512, for the levels that a plan of few calls visits: so two or three calls give what four
or six of the teacher do.
"""

from __future__ import annotations

import torch
from torch import Tensor

from servoid.policy.diffusion.model.config import DenoiserConfig, TrainingObjective
from servoid.policy.diffusion.model.denoiser import Denoiser
from servoid.policy.diffusion.objective import UNTOLD, action_weight, add_noise, token_error
from servoid.policy.diffusion.schedule import ddim_levels

Levels = tuple[Tensor, Tensor]  # of state tokens `(batch, state tokens)`, and of action tokens


def draw_step(
    config: DenoiserConfig, batch: int, steps: int, generator: torch.Generator, inference_delay: int
) -> tuple[Levels, Levels]:
    """Levels before and after one of the calls of a plan with `steps` of them.

    In half of the windows states are a step ahead of actions, as with a lead of one. The past is clean, and so are the
    first 0 to `inference_delay` actions to come, which run while a plan is made.
    """
    ladder = torch.from_numpy(ddim_levels(config.levels, steps))
    lead = torch.randint(2, (batch, 1), generator=generator)
    call = (torch.rand(batch, 1, generator=generator) * (steps + lead)).long()
    given = torch.randint(inference_delay + 1, (batch, 1), generator=generator)
    known = torch.from_numpy(config.state_ticks) <= 0, torch.from_numpy(config.action_ticks) < given

    def at(call: Tensor) -> Levels:
        of_states, of_actions = ladder[call.clamp(0, steps)], ladder[(call - lead).clamp(0, steps)]
        return torch.where(known[0], 0, of_states), torch.where(known[1], 0, of_actions)

    return at(call), at(call + 1)


def stepped(noisy: Tensor, clean: Tensor, before: Tensor, after: Tensor, signal: Tensor) -> Tensor:
    """Tokens `(batch, tokens, features)` after a step of DDIM from one level to another, `(batch, tokens)`."""
    of_clean, of_noisy = _factors(before, after, signal)
    return torch.where((after < before)[..., None], of_clean * clean + of_noisy * noisy, noisy)


def target(noisy: Tensor, reached: Tensor, before: Tensor, after: Tensor, signal: Tensor) -> Tensor:
    """The clean tokens that one step would have to be told to get from `noisy` to `reached`; zero for those at rest."""
    of_clean, of_noisy = _factors(before, after, signal)
    moves = (after < before)[..., None]
    wanted: Tensor = torch.where(moves, (reached - of_noisy * noisy) / torch.where(moves, of_clean, 1.0), 0.0)
    return wanted


def distilled_losses(
    student: Denoiser,
    teacher: Denoiser,
    window: tuple[Tensor, Tensor, Tensor | None],
    signal: Tensor,
    generator: torch.Generator,
    objective: TrainingObjective,
    steps: int,
) -> tuple[Tensor, Tensor]:
    """State and action losses of clean windows (states, actions, text), for plans of `steps` calls.

    One window in ten is shown without its instruction, to both.
    """
    config, (states, actions, text) = student.config, window
    before, after = draw_step(config, len(states), steps, generator, objective.inference_delay)
    middle = (before[0] + after[0] + 1) // 2, (before[1] + after[1] + 1) // 2
    start = [add_noise(x, k, signal, generator) for x, k in zip((states, actions), before, strict=True)]
    text_mask = torch.rand(len(states), generator=generator) >= UNTOLD
    with torch.no_grad():
        at, reached = before, list(start)
        for then in (middle, after):
            clean = teacher(*reached, *at, text, text_mask)
            moves = zip(reached, clean, at, then, strict=True)
            reached = [stepped(noisy, x.float(), a, b, signal) for noisy, x, a, b in moves]
            at = then
    wanted = [target(*parts, signal) for parts in zip(start, reached, before, after, strict=True)]
    predicted = student(*start, *before, text, text_mask)
    moving = [(a > b).float() for a, b in zip(before, after, strict=True)]
    weights = moving[0], moving[1] * action_weight(config, objective.near_actions, objective.far_actions)
    state_loss, action_loss = (token_error(*parts) for parts in zip(predicted, wanted, weights, strict=True))
    return state_loss, action_loss


def _factors(before: Tensor, after: Tensor, signal: Tensor) -> tuple[Tensor, Tensor]:
    """What a step makes of the clean token and of the noisy one (`sampler`, with eta 0), `(batch, tokens, 1)`."""
    a, b = signal[before][..., None], signal[after][..., None]
    of_noisy = ((1 - b) / (1 - a).clamp_min(1e-12)).sqrt()
    return b.sqrt() - of_noisy * a.sqrt(), of_noisy

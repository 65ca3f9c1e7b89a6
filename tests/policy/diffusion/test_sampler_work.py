"""The sampler does no needless work, and what it leaves out changes no plan."""

from __future__ import annotations

import pytest
import torch
from test_runtime import model
from torch import Tensor
from torch_costs import by_torch

from servoid.policy.diffusion import rolling
from servoid.policy.diffusion.guidance import Guidance
from servoid.policy.diffusion.rolling import frame_noise
from servoid.policy.diffusion.sampler import Known, Sampler, draw_noise
from servoid.policy.diffusion.schedule import DenoisingMatrix, cosine_signal, full_sequence

LEVELS = 20
SIGNAL = cosine_signal(LEVELS)


def known() -> Known:
    generator = torch.Generator().manual_seed(4)
    mask = torch.arange(6) < 2
    return Known(torch.randn(2, 6, 3, generator=generator), torch.randn(2, 5, 3, generator=generator), mask, mask[:5])


def generators() -> list[torch.Generator]:
    return [torch.Generator().manual_seed(seed) for seed in (1, 2)]


def predict(states: Tensor, actions: Tensor, state_levels: Tensor, action_levels: Tensor) -> tuple[Tensor, Tensor]:
    clean = 0.9 * states.tanh() + 0.01 * state_levels[:, None] + 0.1 * actions.mean(1, keepdim=True)
    return clean, actions.sin() + 0.1 * states.mean(1, keepdim=True)


def cost(states: Tensor) -> Tensor:
    return (states - 0.5).square().sum((1, 2))


def textbook(matrix: DenoisingMatrix, eta: float, weight: float) -> list[Tensor]:
    """The same samples, term by term as DDIM is written (arXiv:2010.02502, eq. 12 and 16), nothing left out."""
    given, drawn = known(), generators()
    signal = torch.as_tensor(SIGNAL, dtype=torch.float32)
    masks = given.state_mask, given.action_mask
    first = [draw_noise(drawn, *x.shape[1:]) for x in (given.states, given.actions)]
    tokens = [
        torch.where(m[:, None], x, n) for m, x, n in zip(masks, (given.states, given.actions), first, strict=True)
    ]
    held = matrix.hold(*(m.numpy() for m in masks))
    rows = [torch.as_tensor(r) for r in (held.states, held.actions)]
    for call in range(held.calls):
        clean = list(predict(*tokens, rows[0][call], rows[1][call]))
        moves = (rows[0][call + 1] < rows[0][call])[:, None]
        clean[0] = clean[0] - weight * 2 * (clean[0] - 0.5) * moves
        for i in (0, 1):
            a, b = (signal[rows[i][call + later]][:, None] for later in (0, 1))
            noise = (tokens[i] - a.sqrt() * clean[i]) / (1 - a).sqrt().clamp_min(1e-6)
            variance = eta**2 * (1 - b) / (1 - a).clamp_min(1e-6) * (1 - a / b)
            after = b.sqrt() * clean[i] + (1 - b - variance).clamp_min(0).sqrt() * noise
            if eta:
                after = after + variance.clamp_min(0).sqrt() * draw_noise(drawn, *tokens[i].shape[1:])
            tokens[i] = torch.where(rows[i][call + 1][:, None] < rows[i][call][:, None], after, tokens[i])
    return tokens


@pytest.mark.parametrize("eta", [0.0, 0.6, 1.0])
def test_samples_are_those_of_the_equations(eta: float) -> None:
    matrix = full_sequence(LEVELS, 5, 6, 5, lead=2)
    guidance = Guidance(by_torch(cost), 0.1, clip=1e6)
    ours = Sampler(predict, SIGNAL, eta).sample(matrix, known(), generators(), guidance)
    for a, b in zip(ours, textbook(matrix, eta, 0.1), strict=True):
        torch.testing.assert_close(a, b, atol=1e-6, rtol=1e-6)


@pytest.mark.parametrize("gradient", ["analytic", "network"])
def test_guidance_is_asked_only_while_states_can_move(gradient: str) -> None:
    asked = []

    def counted(states: Tensor) -> Tensor:
        asked.append(1)
        return cost(states)

    matrix = full_sequence(LEVELS, 5, 6, 5, lead=3)
    assert matrix.calls == 8
    Sampler(predict, SIGNAL).sample(matrix, known(), generators(), Guidance(by_torch(counted), 0.1, 1e6, gradient))
    assert len(asked) == 5


def test_noise_of_a_frame_is_drawn_once() -> None:
    config = model().config

    def drawn() -> int:
        return rolling._noise_of_frame.cache_info().misses

    before = drawn()
    first = frame_noise(config, [(910, 50)])
    assert drawn() - before == config.history + config.horizon
    next_tick = frame_noise(config, [(910, 51)])
    assert drawn() - before == config.history + config.horizon + 1
    for then, now in zip(first, next_tick, strict=True):
        torch.testing.assert_close(now[:, :-1], then[:, 1:], atol=0, rtol=0)
    assert not torch.equal(frame_noise(config, [(911, 51)])[0], next_tick[0])

"""What a step of training shows the network."""

from __future__ import annotations

from typing import Any

import pytest
import torch
from torch import Tensor

from servoid.policy.diffusion.model.config import DenoiserConfig, TrainingObjective
from servoid.policy.diffusion.model.denoiser import Denoiser
from servoid.policy.diffusion.objective import UNTOLD, losses
from servoid.policy.diffusion.schedule import cosine_signal

WINDOWS, WORDS = 2000, 5
CONFIG = DenoiserConfig(3, 2, width=16, heads=2, history=2, horizon=4, text="words", text_size=WORDS)
OBJECTIVE = TrainingObjective(inference_delay=0, monotone=0.0)
SIGNAL = torch.as_tensor(cosine_signal(CONFIG.levels), dtype=torch.float32)


def batch(seed: int = 0) -> tuple[Tensor, Tensor, Tensor]:
    """Clean states and actions, and a text for each window."""
    generator = torch.Generator().manual_seed(seed)
    tokens = len(CONFIG.state_ticks), len(CONFIG.action_ticks)
    states, actions = (
        torch.randn(WINDOWS, count, size, generator=generator)
        for count, size in zip(tokens, (CONFIG.state_size, CONFIG.action_size), strict=True)
    )
    return states, actions, torch.randn(WINDOWS, WORDS, generator=generator)


def untold(seed: int) -> Tensor:
    """Which windows of a step `(windows,)` teach nothing about their text: the loss has no gradient by it."""
    torch.manual_seed(0)
    network = Denoiser(CONFIG)
    torch.nn.init.normal_(network.no_text)  # as a window without a text is known after some training
    states, actions, text = batch()
    text.requires_grad_()
    parts = losses(network, states, actions, text, SIGNAL, torch.Generator().manual_seed(seed), OBJECTIVE)
    by_text, without = torch.autograd.grad(torch.stack(parts).sum(), (text, network.no_text))
    assert without.abs().max() > 0.0
    return by_text.abs().amax(1) == 0.0


def test_one_window_in_ten_is_not_told_its_text_and_another_one_each_time() -> None:
    """Told all of them, the network would never learn what to do without, and classifier-free guidance not steer."""
    first, again, other = untold(3), untold(3), untold(4)
    assert UNTOLD == 0.1
    for drawn in (first, other):
        assert float(drawn.float().mean()) == pytest.approx(0.1, abs=0.02)  # 3 deviations of so many windows
    assert torch.equal(first, again)
    assert float((first & other).float().mean()) == pytest.approx(0.01, abs=0.007)


def test_the_untold_are_drawn_apart_from_the_noise_levels() -> None:
    """The share of windows for Diffusion Forcing, which come last in a batch, is untold as often as the others."""
    drawn = torch.stack([untold(seed) for seed in range(4)]).float()
    quarters = drawn.view(4, 4, -1).mean((0, 2))
    assert quarters.tolist() == pytest.approx([0.1] * 4, abs=0.025)


def test_a_network_without_words_is_trained_without_them() -> None:
    shape: dict[str, Any] = {"width": 16, "heads": 2, "history": 2, "horizon": 4}
    network = Denoiser(DenoiserConfig(3, 2, **shape))
    states, actions, _ = batch()
    parts = losses(network, states, actions, None, SIGNAL, torch.Generator().manual_seed(3), OBJECTIVE)
    assert all(torch.isfinite(part) for part in parts)

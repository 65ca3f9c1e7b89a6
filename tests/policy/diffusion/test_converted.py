"""A network to begin with may have other units and fewer tokens: what it knows is kept."""

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from servoid.hw.config import ConfigError
from servoid.policy.diffusion.model.checkpoint import Model
from servoid.policy.diffusion.model.config import DenoiserConfig
from servoid.policy.diffusion.model.converted import converted
from servoid.policy.diffusion.model.denoiser import Denoiser
from servoid.policy.features import Emphasis, Normaliser

HISTORY, HORIZON, CODE = 4, 6, 10
OLD = DenoiserConfig(108, 20, "words", CODE, width=32, history=HISTORY, horizon=HORIZON)
NEW = replace(OLD, ticks=tuple(range(1, HORIZON + 1)), clock=2, text_size=CODE + 4)


def units(size: int, seed: int, strength: float = 0.0) -> Normaliser:
    generator = torch.Generator().manual_seed(seed)
    mean, std = torch.randn(size, generator=generator), 0.2 + torch.rand(size, generator=generator)
    plain = Normaliser(mean.numpy(), std.numpy())
    return (Emphasis.of(plain, 20, strength, seed) if strength else plain).to_torch()


@pytest.fixture(scope="module")
def model() -> Model:
    torch.manual_seed(0)
    return Model(Denoiser(OLD).eval(), units(54, 1, 5.0), units(20, 2), {})


@torch.no_grad()
def test_a_network_in_other_units_with_a_clock_predicts_the_same(model: Model) -> None:
    states, actions = units(54, 3, 5.0), units(20, 4)
    other = Denoiser(NEW).eval()
    other.load_state_dict(converted(model, NEW, states, actions))
    generator = torch.Generator().manual_seed(5)
    rows, goals = (torch.randn(2, n, size, generator=generator) for n, size in ((HISTORY + HORIZON, 54), (9, 20)))
    text = torch.randn(2, CODE, generator=generator)
    levels = torch.full((HISTORY + HORIZON,), 3), torch.full((9,), 2)
    before = model.denoiser(model.states.encode(rows), model.actions.encode(goals), *levels, text)
    clock = torch.randn(2, 4, generator=generator)  # which nothing reads as yet
    after = other(states.encode(rows), actions.encode(goals), *levels, torch.cat([text, clock], 1))
    assert torch.allclose(model.states.decode(before[0]), states.decode(after[0]), atol=1e-3)
    assert torch.allclose(model.actions.decode(before[1]), actions.decode(after[1]), atol=1e-3)


def test_another_kind_of_network_is_refused_with_what_differs(model: Model) -> None:
    with pytest.raises(ConfigError, match=r"another one \(width\)"):
        converted(model, replace(NEW, width=64), units(54, 3, 5.0), units(20, 4))
    with pytest.raises(ConfigError, match="emphasis"):
        converted(model, NEW, units(54, 3), units(20, 4))
    with pytest.raises(ConfigError, match="horizon, ticks or clock"):
        converted(model, replace(OLD, horizon=12), units(54, 3, 5.0), units(20, 4))

from __future__ import annotations

from dataclasses import replace

import pytest
import torch

from servoid.hw.config import ConfigError
from servoid.policy.diffusion.model.config import DenoiserConfig
from servoid.policy.diffusion.model.denoiser import Denoiser
from servoid.policy.diffusion.model.masks import attention_mask


def leaks(layers: int, mask: str = "state_full_action_causal") -> tuple[Denoiser, torch.Tensor, torch.Tensor]:
    """Whether output tokens depend on input tokens, `(tokens, tokens)` bool, by the gradient; and the action ticks."""
    torch.manual_seed(0)
    config = DenoiserConfig(5, 3, layers=layers, width=16, heads=2, history=3, horizon=4, mask=mask)
    denoiser = Denoiser(config).double()
    states = torch.randn(1, len(config.state_ticks), 5, dtype=torch.double, requires_grad=True)
    actions = torch.randn(1, len(config.action_ticks), 3, dtype=torch.double, requires_grad=True)
    levels = torch.full((len(config.state_ticks),), 7), torch.full((len(config.action_ticks),), 7)
    out_states, out_actions = denoiser(states, actions, *levels)
    rows = []
    for output in (*out_states[0], *out_actions[0]):
        gradients = torch.autograd.grad(output.sum(), (states, actions), retain_graph=True, allow_unused=True)
        parts = [torch.zeros_like(x) if g is None else g for g, x in zip(gradients, (states, actions), strict=True)]
        rows.append(torch.cat([part[0].abs().sum(-1) for part in parts]) > 0)
    return denoiser, torch.stack(rows), torch.as_tensor(config.action_ticks)


def test_one_layer_leaks_exactly_what_the_diffuse_cloc_mask_lets_through() -> None:
    denoiser, leak, action_ticks = leaks(layers=1)
    n = len(denoiser.config.state_ticks)
    state_ticks = torch.as_tensor(denoiser.config.state_ticks)
    assert leak[:n, :n].all()  # states see all states, past and future
    assert not leak[:n, n:].any()  # and no action
    assert torch.equal(leak[n:, :n], state_ticks[None] <= action_ticks[:, None])
    assert torch.equal(leak[n:, n:], action_ticks[None] <= action_ticks[:, None])


def test_with_two_layers_future_states_reach_the_present_action_but_future_actions_never_do() -> None:
    # This is the way by which guidance on states steers actions.
    denoiser, leak, action_ticks = leaks(layers=2)
    n = len(denoiser.config.state_ticks)
    assert leak[n:, :n].all()
    assert torch.equal(leak[n:, n:], action_ticks[None] <= action_ticks[:, None])


def test_full_mask_lets_everything_through() -> None:
    assert leaks(layers=1, mask="full")[1].all()


def frames(denoiser: Denoiser) -> torch.Tensor:
    """The frame of each token: an action goes with the state that it leads to."""
    config = denoiser.config
    return torch.cat([torch.as_tensor(config.state_ticks) - 1, torch.as_tensor(config.action_ticks)])


@pytest.mark.parametrize("layers", [1, 3])
def test_the_uniphys_mask_lets_nothing_through_from_a_later_frame_however_deep_the_network(layers: int) -> None:
    denoiser, leak, _ = leaks(layers, mask="causal")
    frame = frames(denoiser)
    assert torch.equal(leak, frame[None] <= frame[:, None])


def test_the_diffuser_mask_is_local_and_a_layer_reaches_one_tick_further() -> None:
    for layers in (1, 2):
        denoiser, leak, action_ticks = leaks(layers, mask="diffuser_local")
        ticks = torch.cat([torch.as_tensor(denoiser.config.state_ticks), action_ticks])
        assert torch.equal(leak, (ticks[None] - ticks[:, None]).abs() <= layers)


def test_an_unknown_mask_is_refused_with_the_nearest_name() -> None:
    config = DenoiserConfig(5, 3)
    with pytest.raises(ConfigError, match="did you mean 'state_full_action_causal'"):
        attention_mask("state_full_action_casual", config.state_ticks, config.action_ticks)
    with pytest.raises(ConfigError, match="did you mean 'causal'"):
        replace(config, mask="casual")  # before a network is made, or data are read for one
    with pytest.raises(ConfigError, match="did you mean 'causal'"):
        Denoiser(DenoiserConfig(5, 3, mask="casual"))


def test_training_and_inference_attend_alike() -> None:
    # Two implementations: a quick one forwards, and one that is quick backwards.
    torch.manual_seed(0)
    config = DenoiserConfig(5, 3, width=16, heads=2)
    denoiser = Denoiser(config)
    states, actions = torch.randn(2, len(config.state_ticks), 5), torch.randn(2, len(config.action_ticks), 3)
    levels = torch.arange(len(config.state_ticks)), torch.arange(len(config.action_ticks))
    trained = denoiser(states, actions, *levels)
    with torch.inference_mode():
        inferred = denoiser(states, actions, *levels)
    for a, b in zip(trained, inferred, strict=True):
        torch.testing.assert_close(a.detach(), b, atol=1e-5, rtol=1e-4)

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from torch import Tensor
from torch_costs import by_torch

from servoid.hw.config import ConfigError
from servoid.policy.diffusion.guidance import Diverged, Guidance, classifier_free
from servoid.policy.diffusion.model.config import DenoiserConfig, TrainingObjective
from servoid.policy.diffusion.model.denoiser import Denoiser
from servoid.policy.diffusion.objective import losses
from servoid.policy.diffusion.sampler import Known, Sampler
from servoid.policy.diffusion.schedule import Rolling, autoregressive, cosine_signal, full_sequence, rolling

LEVELS = 100
SIGNAL = torch.as_tensor(cosine_signal(LEVELS), dtype=torch.float32)


def unknown(batch: int, tokens: int = 1) -> Known:
    return Known(
        torch.zeros(batch, tokens, 1),
        torch.zeros(batch, tokens, 1),
        torch.zeros(tokens, dtype=torch.bool),
        torch.zeros(tokens, dtype=torch.bool),
    )


def generators(batch: int, seed: int = 0) -> list[torch.Generator]:
    return [torch.Generator().manual_seed(1000 * seed + i) for i in range(batch)]


def mixture(weights: Tensor, means: Tensor, deviation: float) -> object:
    """The exact predictor of x0, E[x0 | xk], for a mixture of normal distributions."""

    def clean(x: Tensor, levels: Tensor) -> Tensor:
        a = SIGNAL[levels][:, None]
        variance = a * deviation**2 + 1 - a
        log = weights.log() - 0.5 * (x - a.sqrt() * means).square() / variance
        share = log.softmax(-1)
        each = means + a.sqrt() * deviation**2 / variance * (x - a.sqrt() * means)
        return (share * each).sum(-1, keepdim=True)

    return lambda s, a, ks, ka: (clean(s, ks), clean(a, ka))


# DDPM leaves out how uncertain each prediction is: its samples are narrower the fewer the levels.
@pytest.mark.slow
@pytest.mark.parametrize(("eta", "steps", "count", "narrow"), [(0.0, 50, 4000, 0.05), (1.0, LEVELS, 1500, 0.08)])
def test_samples_have_the_mean_and_spread_of_the_distribution(
    eta: float, steps: int, count: int, narrow: float
) -> None:
    predict = mixture(torch.tensor([1.0]), torch.tensor([0.7]), 0.5)
    states, actions = Sampler(predict, cosine_signal(LEVELS), eta).sample(
        full_sequence(LEVELS, steps, 1, 1), unknown(count), generators(count)
    )
    for x in (states, actions):
        assert x.mean().item() == pytest.approx(0.7, abs=0.03)
        assert x.std().item() == pytest.approx(0.5, rel=narrow)


def test_both_modes_are_sampled_in_proportion() -> None:
    predict = mixture(torch.tensor([0.3, 0.7]), torch.tensor([-2.0, 1.0]), 0.2)
    states, _ = Sampler(predict, cosine_signal(LEVELS)).sample(
        full_sequence(LEVELS, 50, 1, 1), unknown(4000), generators(4000)
    )
    right = states[states > -0.5]
    assert len(right) / 4000 == pytest.approx(0.7, abs=0.03)
    assert right.mean().item() == pytest.approx(1.0, abs=0.03)
    assert right.std().item() == pytest.approx(0.2, rel=0.12)


def test_known_tokens_come_back_untouched_and_are_shown_clean() -> None:
    seen = []

    def predict(s: Tensor, a: Tensor, ks: Tensor, ka: Tensor) -> tuple[Tensor, Tensor]:
        seen.append((s[:, 0].clone(), ks[0].item(), a[:, 1].clone(), ka[1].item()))
        return torch.full_like(s, 9.0), torch.full_like(a, 9.0)

    known = unknown(2, tokens=2)
    known.states[:, 0], known.actions[:, 1] = 3.0, 4.0
    known.state_mask[0] = known.action_mask[1] = True
    states, actions = Sampler(predict, cosine_signal(20)).sample(full_sequence(20, 4, 2, 2), known, generators(2))
    assert states[:, 0].eq(3.0).all()
    assert states[:, 1].eq(9.0).all()
    assert actions[:, 1].eq(4.0).all()
    assert len(seen) == 4
    for state, state_level, action, action_level in seen:
        assert state.eq(3.0).all()
        assert action.eq(4.0).all()
        assert state_level == action_level == 0


def test_a_sample_depends_on_its_own_generator_only() -> None:
    sampler = Sampler(mixture(torch.tensor([1.0]), torch.tensor([0.0]), 1.0), cosine_signal(LEVELS))
    matrix = full_sequence(LEVELS, 5, 1, 1)
    many, _ = sampler.sample(matrix, unknown(5), generators(5))
    alone, _ = sampler.sample(matrix, unknown(1), generators(5)[3:4])
    torch.testing.assert_close(alone[0], many[3], rtol=0, atol=0)
    other, _ = sampler.sample(matrix, unknown(5), generators(5, seed=1))
    assert not torch.equal(other, many)


def test_the_noise_of_ddpm_is_drawn_from_the_samples_own_generator() -> None:
    predict = mixture(torch.tensor([1.0]), torch.tensor([0.0]), 1.0)
    matrix = full_sequence(LEVELS, 5, 1, 1)
    plain, _ = Sampler(predict, cosine_signal(LEVELS)).sample(matrix, unknown(3), generators(3))
    ancestral = Sampler(predict, cosine_signal(LEVELS), eta=1.0)
    many, _ = ancestral.sample(matrix, unknown(3), generators(3))
    alone, _ = ancestral.sample(matrix, unknown(1), generators(3)[2:])
    torch.testing.assert_close(alone[0], many[2], rtol=0, atol=0)
    assert not torch.equal(many, plain)


def test_finished_tokens_are_shown_slightly_noisy_and_keep_their_values() -> None:
    shown, values = [], []

    def predict(s: Tensor, a: Tensor, ks: Tensor, ka: Tensor) -> tuple[Tensor, Tensor]:
        shown.append(torch.cat([ks, ka]).tolist())
        values.append(s[0, 0].item())
        return torch.full_like(s, 9.0), torch.full_like(a, 9.0)

    known = unknown(1, tokens=3)
    known.states[:, 0] = 3.0
    known.state_mask[0] = True
    matrix = autoregressive(20, 2, np.arange(3), np.arange(3))
    states, _ = Sampler(predict, cosine_signal(20), stabilization_level=3).sample(matrix, known, generators(1))
    assert shown[0] == [3, 20, 20, 20, 20, 20]
    assert shown[2] == [3, 20, 20, 3, 20, 20]
    assert shown[4] == [3, 3, 20, 3, 3, 20]
    assert values == [3.0] * 6
    assert states[0, :, 0].tolist() == [3.0, 9.0, 9.0]


def test_sampling_can_go_on_from_a_noisy_start() -> None:
    seen = []

    def predict(s: Tensor, a: Tensor, ks: Tensor, ka: Tensor) -> tuple[Tensor, Tensor]:
        seen.append((s.clone(), ks.tolist(), ka.tolist()))
        return s, a

    start = torch.full((1, 2, 1), 5.0), torch.full((1, 2, 1), 6.0)
    matrix = rolling(20, 2, np.arange(2), np.arange(2), Rolling(14, 4, ramp=1))
    Sampler(predict, cosine_signal(20)).sample(matrix, unknown(1, tokens=2), generators(1), start=start)
    assert seen[0][0].eq(5.0).all()
    assert seen[0][1:] == ([14, 20], [4, 20])


def test_what_is_known_of_a_state_replaces_the_prediction_and_the_rest_follows_the_network() -> None:
    def pin(clean: Tensor) -> Tensor:
        return torch.cat([torch.full_like(clean[..., :1], 2.0), clean[..., 1:]], -1)

    known = Known(torch.zeros(4, 3, 2), torch.zeros(4, 1, 1), torch.zeros(3).bool(), torch.zeros(1).bool(), pin)
    sampler = Sampler(lambda s, a, ks, ka: (s, a), cosine_signal(20))
    states, _ = sampler.sample(full_sequence(20, 4, 3, 1), known, generators(4))
    assert states[..., 0].eq(2.0).all()
    assert states[..., 1].std() > 0.1


@pytest.mark.parametrize("gradient", ["analytic", "network"])
def test_monte_carlo_guidance_moves_the_samples_of_a_window_by_their_mean_gradient(gradient: str) -> None:
    sampler = Sampler(lambda s, a, ks, ka: (s, a), cosine_signal(LEVELS))
    matrix, known = full_sequence(LEVELS, 1, 2, 2), unknown(6, tokens=2)
    plain, _ = sampler.sample(matrix, known, generators(6))
    guidance = Guidance(by_torch(lambda s: 0.5 * s.square().sum((1, 2))), 0.1, clip=10.0, gradient=gradient, samples=3)
    guided, _ = sampler.sample(matrix, known, generators(6), guidance)
    mean = plain.unflatten(0, (2, 3)).mean(1).repeat_interleave(3, 0)  # of each sample's own gradient
    torch.testing.assert_close(plain - guided, 0.1 * mean, atol=1e-5, rtol=1e-4)


def test_a_weight_beyond_all_bounds_is_an_error_that_says_so() -> None:
    sampler = Sampler(lambda s, a, ks, ka: (s, a), cosine_signal(LEVELS))
    guidance = Guidance(by_torch(lambda s: s.square().sum((1, 2))), weight=1e39, clip=1.0)
    with pytest.raises(Diverged, match=r"weight of 1e\+39 moves this trajectory out of all bounds; lower it"):
        sampler.sample(full_sequence(LEVELS, 1, 1, 1), unknown(1), generators(1), guidance)


def test_frames_whose_turn_has_not_come_use_nothing_of_the_guidance_step_up() -> None:
    sampler = Sampler(lambda s, a, ks, ka: (torch.zeros_like(s), a), cosine_signal(LEVELS))
    guidance = Guidance(by_torch(lambda s: s.sum((1, 2))), weight=100.0, clip=0.5)
    matrix = autoregressive(LEVELS, 1, np.arange(2), np.arange(2))
    states, _ = sampler.sample(matrix, unknown(1, tokens=2), generators(1), guidance)
    torch.testing.assert_close(states[0, :, 0], torch.tensor([-0.5, -0.5]))


@pytest.mark.parametrize("gradient", ["analytic", "network"])
def test_a_guidance_step_is_never_longer_than_its_clip(gradient: str) -> None:
    # One call from pure noise whose prediction is its input: the sample is that prediction, moved.
    sampler = Sampler(lambda s, a, ks, ka: (s, a), cosine_signal(LEVELS))
    matrix, known = full_sequence(LEVELS, 1, 2, 2), unknown(3, tokens=2)
    plain, _ = sampler.sample(matrix, known, generators(3))
    guidance = Guidance(by_torch(lambda s: 1e6 * s.sum((1, 2))), weight=1.0, clip=0.25, gradient=gradient)
    guided, _ = sampler.sample(matrix, known, generators(3), guidance)
    torch.testing.assert_close((guided - plain).flatten(1).norm(dim=1), torch.full((3,), 0.25))
    gentle = Guidance(by_torch(lambda s: 0.1 * s.sum((1, 2))), weight=1.0, clip=5.0, gradient=gradient)
    guided, _ = sampler.sample(matrix, known, generators(3), gentle)
    torch.testing.assert_close(plain - guided, torch.full((3, 2, 1), 0.1))


def test_known_states_do_not_use_up_the_guidance_step() -> None:
    sampler = Sampler(lambda s, a, ks, ka: (torch.zeros_like(s), a), cosine_signal(LEVELS))
    known = unknown(1, tokens=2)
    known.state_mask[0] = True
    guidance = Guidance(by_torch(lambda s: s.sum((1, 2))), weight=100.0, clip=0.5)
    states, _ = sampler.sample(full_sequence(LEVELS, 1, 2, 2), known, generators(1), guidance)
    torch.testing.assert_close(states[0, :, 0], torch.tensor([0.0, -0.5]))


@pytest.mark.parametrize("deviation", [0.3, 1.0])
def test_scaled_guidance_moves_the_mean_of_a_normal_distribution_to_where_theory_puts_it(deviation: float) -> None:
    """N(m, s^2) exp(-c x) is N(m - c s^2, s^2): whatever the levels, and whatever the spread of the data."""
    sampler = Sampler(mixture(torch.tensor([1.0]), torch.tensor([0.7]), deviation), cosine_signal(LEVELS))
    matrix, known, slope = full_sequence(LEVELS, 50, 1, 1), unknown(2000), 0.8
    guidance = Guidance(by_torch(lambda s: slope * s.sum((1, 2))), 1.0, clip=100.0, gradient="network", scaled=True)
    plain, _ = sampler.sample(matrix, known, generators(2000))
    guided, _ = sampler.sample(matrix, known, generators(2000), guidance)
    assert (plain - guided).mean().item() == pytest.approx(slope * deviation**2, rel=0.06)
    assert guided.std().item() == pytest.approx(deviation, rel=0.06)


def test_actions_guided_by_the_networks_jacobian_go_where_theory_puts_them() -> None:
    """Of a state and an action that vary together, exp(-c state) moves the action's mean by c times the covariance."""
    both = torch.tensor([[1.0, 0.6], [0.6, 0.8]])

    def predict(s: Tensor, a: Tensor, ks: Tensor, ka: Tensor) -> tuple[Tensor, Tensor]:
        signal = SIGNAL[ks[0]]  # that of both: they are denoised together
        noisy = torch.cat([s, a], -1)[:, 0]
        clean = signal.sqrt() * noisy @ torch.linalg.inv(signal * both + (1 - signal) * torch.eye(2)) @ both
        return clean[:, None, :1], clean[:, None, 1:]

    def means(guidance: Guidance | None) -> Tensor:
        sampler = Sampler(predict, cosine_signal(LEVELS))
        parts = sampler.sample(full_sequence(LEVELS, 50, 1, 1), unknown(500), generators(500), guidance)
        return torch.cat(parts, -1)[:, 0].mean(0)

    guidance = Guidance(by_torch(lambda s: 0.8 * s.sum((1, 2))), 1.0, clip=100.0, gradient="network", scaled=True)
    plain = means(None)
    assert (plain - means(replace(guidance, actions=True))).tolist() == pytest.approx([0.8, 0.48], rel=0.06)
    assert (plain - means(replace(guidance, actions=True, repeats=3))).tolist() == pytest.approx([0.8, 0.48], rel=0.06)
    assert (plain - means(guidance))[1].item() < 0.4, "they follow the states, but not so far"


def fixed(value: float, guidance: Guidance, tokens: int = 1) -> Tensor:
    """What a network that predicts `value` for all states samples under guidance, in one call, `(tokens,)`."""
    sampler = Sampler(lambda s, a, ks, ka: (torch.full_like(s, value), a), cosine_signal(LEVELS))
    return sampler.sample(full_sequence(LEVELS, 1, tokens, 1), unknown(1, tokens), generators(1), guidance)[0][0, :, 0]


def test_a_limited_step_does_not_go_beyond_where_the_cost_would_be_zero() -> None:
    def cost(s: Tensor) -> Tensor:
        return s.abs().sum((1, 2))  # zero at 0

    assert fixed(1.0, Guidance(by_torch(cost), 5.0, clip=100.0)).item() == pytest.approx(-4.0)
    assert fixed(1.0, Guidance(by_torch(cost), 5.0, clip=100.0, limited=True)).item() == pytest.approx(0.0, abs=1e-6)
    assert fixed(1.0, Guidance(by_torch(cost), 0.4, clip=100.0, limited=True)).item() == pytest.approx(0.6)


def test_steps_repeated_at_a_level_follow_the_gradient_as_it_changes() -> None:
    def cost(s: Tensor) -> Tensor:
        return s.square().sum((1, 2))

    assert fixed(1.0, Guidance(by_torch(cost), 0.8, clip=100.0)).item() == pytest.approx(
        1.0 - 1.6
    )  # beyond the least cost
    assert fixed(1.0, Guidance(by_torch(cost), 0.8, clip=100.0, repeats=4)).item() == pytest.approx(0.6**4)


def test_even_gradients_move_each_token_as_far() -> None:
    def cost(s: Tensor) -> Tensor:
        return (s[..., 0] * torch.tensor([1.0, 3.0])).sum(1)

    assert fixed(0.0, Guidance(by_torch(cost), 1.0, clip=100.0), tokens=2).tolist() == pytest.approx([-1.0, -3.0])
    assert fixed(0.0, Guidance(by_torch(cost), 1.0, clip=100.0, even=True), tokens=2).tolist() == pytest.approx(
        [-2.0, -2.0]
    )


def test_a_cost_without_a_finite_gradient_is_an_error() -> None:
    sampler = Sampler(lambda s, a, ks, ka: (torch.zeros_like(s), a), cosine_signal(LEVELS))
    guidance = Guidance(by_torch(lambda s: s.norm(dim=(1, 2)).sqrt()), weight=1.0, clip=1.0)
    with pytest.raises(Diverged, match="no finite gradient"):
        sampler.sample(full_sequence(LEVELS, 1, 1, 1), unknown(1), generators(1), guidance)


@pytest.mark.parametrize("cost", [np.nan, np.inf])
@pytest.mark.parametrize("limited", [False, True])
def test_a_cost_that_is_not_finite_is_an_error_though_its_gradient_is(cost: float, limited: bool) -> None:
    sampler = Sampler(lambda s, a, ks, ka: (torch.zeros_like(s), a), cosine_signal(LEVELS))
    guidance = Guidance(lambda s: (np.full(len(s), cost), np.ones_like(s)), weight=1.0, clip=1.0, limited=limited)
    with pytest.raises(Diverged, match="cost is not finite"):
        sampler.sample(full_sequence(LEVELS, 1, 1, 1), unknown(1), generators(1), guidance)


def test_an_unknown_gradient_is_refused() -> None:
    with pytest.raises(ConfigError, match="'numeric'"):
        Guidance(by_torch(lambda s: s.sum()), 1.0, 1.0, gradient="numeric")


@pytest.fixture(scope="module")
def planner() -> tuple[Denoiser, Sampler]:
    """A denoiser trained on windows in which all that is to come, states and actions, is one number around 0."""
    torch.manual_seed(0)
    config = DenoiserConfig(1, 1, width=32, heads=2, history=1, horizon=4, levels=20)
    denoiser, generator = Denoiser(config), torch.Generator().manual_seed(0)
    signal = torch.as_tensor(cosine_signal(config.levels), dtype=torch.float32)
    optimiser = torch.optim.AdamW(denoiser.parameters(), 3e-3)
    for step in range(400):
        optimiser.param_groups[0]["lr"] = 3e-3 * (1 - step / 400) * min(1.0, (step + 1) / 20)
        z = torch.randn(64, 1, 1, generator=generator)
        states = z.repeat(1, 5, 1)
        states[:, 0] = 0.0  # the present says nothing
        loss = sum(
            losses(
                denoiser,
                states,
                z.repeat(1, 4, 1),
                None,
                signal,
                generator,
                TrainingObjective(inference_delay=0, monotone=0.0),
            )
        )
        optimiser.zero_grad()
        loss.backward()
        optimiser.step()
    denoiser.eval().requires_grad_(False)
    return denoiser, Sampler(denoiser, cosine_signal(config.levels))


@pytest.mark.parametrize(("gradient", "lead"), [("analytic", 0), ("analytic", 2), ("network", 0)])
def test_guiding_states_moves_the_actions(planner: tuple[Denoiser, Sampler], gradient: str, lead: int) -> None:
    # Even the present action, which attends to no future state and takes all its news from the present state's token.
    _, sampler = planner
    known = Known(torch.zeros(256, 5, 1), torch.zeros(256, 4, 1), torch.arange(5) < 1, torch.zeros(4, dtype=torch.bool))
    matrix = full_sequence(20, 5, 5, 4, lead=lead)
    guidance = Guidance(by_torch(lambda s: (s[:, 1:] - 1.5).square().sum((1, 2))), 0.3, 10.0, gradient)
    with torch.no_grad():
        states, actions = sampler.sample(matrix, known, generators(256))
        guided_states, guided_actions = sampler.sample(matrix, known, generators(256), guidance)
    # Unguided, both spread around 0, and each present action belongs to the states of its own sample.
    assert abs(states[:, 1:].mean()) < 0.2
    assert abs(actions[:, 0].mean()) < 0.2
    assert torch.corrcoef(torch.stack([states[:, 1, 0], actions[:, 0, 0]]))[0, 1] > 0.95
    assert guided_states[:, 1:].mean() > 1.2
    # The last call sees states that are guided already; with a lead it sees the finished ones, and follows them closer.
    assert guided_actions[:, 0].mean() > (1.3 if lead else 0.8)


def test_classifier_free_guidance_goes_beyond_what_an_instruction_makes_of_a_window() -> None:
    torch.manual_seed(0)
    config = DenoiserConfig(3, 2, width=16, heads=2, history=1, horizon=4, text="words", text_size=5)
    denoiser, text = Denoiser(config).eval(), torch.randn(6, 5)
    window = torch.randn(6, 5, 3), torch.randn(6, 4, 2), torch.full((5,), 7), torch.full((4,), 7)
    with torch.no_grad():
        bare, told = denoiser(*window), denoiser(*window, text=text)
        for weight in (0.0, 1.0, 2.5):
            guided = classifier_free(denoiser, text, weight)(*window)
            for x, without, with_text in zip(guided, bare, told, strict=True):
                torch.testing.assert_close(x, without + weight * (with_text - without), atol=1e-5, rtol=1e-4)
    assert (bare[0] - told[0]).abs().max() > 1e-4


def test_windows_of_a_batch_without_an_instruction_do_not_see_one() -> None:
    torch.manual_seed(0)
    config = DenoiserConfig(3, 2, width=16, heads=2, history=1, horizon=4, text="words", text_size=5)
    denoiser = Denoiser(config).eval()
    window = torch.randn(2, 5, 3), torch.randn(2, 4, 2), torch.full((5,), 7), torch.full((4,), 7)
    with torch.no_grad():
        mixed = denoiser(*window, text=torch.randn(2, 5), text_mask=torch.tensor([True, False]))
        bare = denoiser(*window)
    torch.testing.assert_close(mixed[0][1], bare[0][1])
    assert (mixed[0][0] - bare[0][0]).abs().max() > 1e-4

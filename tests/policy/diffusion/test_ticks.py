"""State tokens at ticks that the checkpoint lists: near ones all, far ones ever further apart."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
import torch
from test_rolling import ROLLING, with_keyframes
from test_runtime import ROBOT, SETTINGS, model, request, seeded_with, speed_cost

from servoid.hw.config import ConfigError
from servoid.hw.contracts.control import Plan
from servoid.policy.checkpoint import Origin
from servoid.policy.diffusion.dataset import Windows
from servoid.policy.diffusion.model import checkpoint
from servoid.policy.diffusion.model.config import DenoiserConfig
from servoid.policy.diffusion.model.denoiser import Denoiser
from servoid.policy.diffusion.model.masks import diffuser_local
from servoid.policy.diffusion.rolling import Previous, frame_noise
from servoid.policy.diffusion.runtime import Runtime
from servoid.policy.diffusion.settings import DiffusionSettings
from servoid.policy.features import raw_layout
from servoid.policy.recording import read_recording

TICKS = (1, 2, 3, 4, 6, 8, 12, 16, 24, 32)
SHAPE = {"horizon": 32, "ticks": TICKS, "actions": 8}


@pytest.mark.parametrize("ticks", [(2, 4, 16), (1, 4, 4, 16), (1, 8), (1, 8, 24)])
def test_ticks_that_do_not_rise_from_the_next_one_to_the_horizon_are_refused(ticks: tuple[int, ...]) -> None:
    with pytest.raises(ConfigError, match="ticks must rise from 1 to the horizon of 16"):
        DenoiserConfig(54, 20, horizon=16, ticks=ticks)


def test_a_network_knows_the_tick_of_each_token() -> None:
    """Two lists of as many ticks make networks of the same weights that see another time."""
    torch.manual_seed(0)
    near = Denoiser(DenoiserConfig(54, 20, width=32, horizon=8, ticks=(1, 2, 8))).eval()
    far = Denoiser(DenoiserConfig(54, 20, width=32, horizon=16, ticks=(1, 2, 16), actions=8)).eval()
    far.load_state_dict(near.state_dict())
    window = torch.randn(1, 7, 54), torch.randn(1, 11, 20), torch.full((7,), 5), torch.full((11,), 5)
    with torch.no_grad():
        ours, theirs = near(*window)[0], far(*window)[0]
    assert (ours - theirs)[:, -1].abs().max() > 1e-3


def test_a_checkpoint_keeps_its_ticks(tmp_path: Path) -> None:
    made, path = model(**SHAPE), tmp_path / "ahead.safetensors"
    trained = checkpoint.Trained(made.denoiser.state_dict(), made.config, made.states, made.actions)
    checkpoint.save(path, trained, ROBOT, Origin("data", "Apache-2.0", {}, {}))
    loaded = checkpoint.load(path, ROBOT)
    assert loaded.config == made.config
    assert loaded.config.future_ticks.tolist() == list(TICKS)
    np.testing.assert_array_equal(
        Runtime(loaded, SETTINGS, ROBOT).plan(request()).actions, Runtime(made, SETTINGS, ROBOT).plan(request()).actions
    )


@pytest.mark.parametrize("schedule", ["full_sequence", "autoregressive", "pyramid", "rolling"])
def test_every_schedule_plans_by_ticks(schedule: str) -> None:
    settings = replace(SETTINGS, schedule=schedule)
    asked = request()
    plan = Runtime(model(**SHAPE), settings, ROBOT, speed_cost).plan(seeded_with(asked, 7))
    assert plan.ticks is not None
    assert plan.ticks.tolist() == list(TICKS)
    assert plan.states.shape == (len(TICKS), raw_layout(20).size)
    assert plan.path.shape == (len(TICKS), 2)
    assert plan.actions.shape == (8, 20)
    np.testing.assert_allclose(plan.actions[:2], asked.actions[3:], atol=1e-6)
    assert np.isfinite(plan.states).all()


def test_a_horizon_ends_at_a_tick_that_is_listed() -> None:
    plan = Runtime(model(**SHAPE), replace(SETTINGS, horizon=12), ROBOT).plan(request())
    assert plan.ticks is not None
    assert plan.ticks.tolist() == [1, 2, 3, 4, 6, 8, 12]
    with pytest.raises(
        ConfigError, match=r"horizon is 10, but this checkpoint plans states at ticks 1, .* give one of"
    ):
        Runtime(model(**SHAPE), replace(SETTINGS, horizon=10), ROBOT)


def test_a_keyframe_counts_when_it_comes_to_a_tick_that_has_a_token() -> None:
    runtime, asked = Runtime(model(**SHAPE), DiffusionSettings(steps=3), ROBOT), request()
    whole, rows = with_keyframes(6, 9, 16)
    plan = runtime.plan(replace(asked, instruction=whole))
    np.testing.assert_allclose(plan.states[[TICKS.index(6), TICKS.index(16)]], rows[[0, 2]], atol=2e-3)


def test_an_earlier_plan_is_read_between_its_ticks() -> None:
    ticks, age = np.array(TICKS), 3
    states = np.repeat(0.1 * ticks[:, None], raw_layout(20).size, 1)[None]
    previous = Previous(age, states, np.zeros((1, 8, 20)), ticks)
    kept = previous.states_at(ticks)
    known = ticks[ticks + age <= 32]
    np.testing.assert_allclose(kept[0, :, 0], 0.1 * (known + age), atol=1e-6)


def test_rolling_goes_on_from_a_plan_by_ticks() -> None:
    runtime, asked = Runtime(model(**SHAPE), ROLLING, ROBOT), request(delay=1)
    first = runtime.plan(seeded_with(replace(asked, tick=39), 7))
    assert isinstance(first, Plan)
    warm = runtime.plan(seeded_with(replace(asked, previous=first), 7))
    moved = replace(first, states=first.states + 0.05)
    assert np.isfinite(warm.states).all()
    assert np.abs(runtime.plan(seeded_with(replace(asked, previous=moved), 7)).states - warm.states).max() > 1e-3
    # Near frames keep their noise when the tick goes on.
    config = runtime.model.config
    now, later = (frame_noise(config, [(7, tick)])[0][0] for tick in (40, 41))
    assert torch.equal(now[1:8], later[:7])


def test_neighbours_are_the_next_ticks_that_have_tokens() -> None:
    states, actions = np.array([-1, 0, 1, 2, 4, 8]), np.array([-1, 0, 1])
    mask = diffuser_local(states, actions)
    assert mask[5].tolist() == [False] * 4 + [True, True] + [False] * 3
    assert mask[0, :3].tolist() == [True, True, False]


def test_windows_hold_the_states_of_their_ticks(synthetic_dataset: Path) -> None:
    recording = read_recording(synthetic_dataset, ROBOT)
    windows = Windows(recording, ROBOT, DenoiserConfig(54, 20, width=32, **SHAPE))
    present = windows.training[:1]
    states, _ = windows._gather(present, torch.zeros(1, dtype=torch.bool))
    row = raw_layout(20).slice("position")
    raw = recording.raw[int(present[0]) + np.array(TICKS)][:, row]
    np.testing.assert_allclose(states[0, 4:, 14:34].numpy(), raw, atol=1e-6)

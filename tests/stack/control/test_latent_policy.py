"""A policy whose plans are latents: each is decoded at its own tick, with the state of that tick."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from test_diffusion_policy import INSTRUCTION, ROBOT, Spy, state

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Plan, PlanRequest
from servoid.policy.checkpoint import CheckpointError, Origin, read, read_header, write
from servoid.policy.diffusion.model import checkpoint
from servoid.policy.diffusion.model.config import DenoiserConfig
from servoid.policy.diffusion.model.denoiser import Denoiser
from servoid.policy.diffusion.settings import DiffusionSettings
from servoid.policy.features import Normaliser, raw_layout, raw_row
from servoid.policy.latent.actions import LatentActions, LatentConfig, proprioception_layout
from servoid.policy.latent.network import LatentNetwork
from servoid.stack.control.diffusion import DiffusionPolicy, diffusion_policy
from servoid.stack.control.planning.plan_buffer import Pace

SIZE = 3
HEIGHT = raw_layout(20).slice("displacement").stop - 1


class Marked:
    """A latent of one number; a target is the latent plus the height, which tells the tick: see `state`."""

    def encode(self, rows: Array, targets: Array) -> Array:
        return targets[..., :1] - 100 * rows[..., HEIGHT : HEIGHT + 1]

    def decode(self, rows: Array, actions: Array) -> Array:
        return (actions + 100 * rows[..., HEIGHT : HEIGHT + 1]) * np.ones(20)


def marked(asked: PlanRequest) -> Plan:
    """A plan whose latent for tick t is 1000 * its own tick."""
    return Plan(asked.tick, np.full((9, 1), 1000.0 * asked.tick), np.zeros((9, 53)), np.zeros((9, 2)), 0.0)


def policy(delay: int, late: dict[int, int] | None = None) -> tuple[DiffusionPolicy, Spy]:
    spy = Spy(late)
    spy._answer = marked
    return DiffusionPolicy(spy, Pace(4, 4, delay), space=Marked()), spy


def run(of: DiffusionPolicy, ticks: int, changed: float = 0.0) -> list[float]:
    """The first joint's targets; the guard adds `changed` to what is sent."""
    applied, out = np.full(20, 0.5), []
    for tick in range(ticks):
        target = of.act(state(tick), applied, INSTRUCTION)
        applied = target + changed
        out.append(float(target[0]))
    return out


def test_a_latent_is_decoded_with_the_state_of_its_own_tick() -> None:
    # The plan of tick 4 has one latent, 4000, and its targets are 4000 + the tick; with the state that was planned from
    # they would all be 4004.
    assert run(policy(delay=2)[0], 14) == pytest.approx(
        [0.5] * 6 + [4006, 4007, 4008, 4009, 8010, 8011, 8012, 8013], rel=1e-6
    )


def test_a_request_holds_what_ran_encoded_with_its_state_and_the_latents_that_will_run() -> None:
    of, spy = policy(delay=2)
    run(of, 13, changed=0.25)
    # At ticks 9 to 11 ran what the guard made of them: encoded with the state of that tick, not of the one after.
    expected = [4000.25, 8000.25, 8000.25, 8000, 8000]
    np.testing.assert_allclose(spy.requests[2].actions[:, 0], expected, atol=0.01)
    # Before the first plan a pose is held: that is encoded with the present state.
    np.testing.assert_allclose(spy.requests[0].actions[3:, 0], [0.5 - 4, 0.5 - 4], atol=1e-4)


def test_the_last_target_is_held_when_a_plan_has_run_out() -> None:
    """A latent that was meant for one state and is decoded with another is no pose to wait in."""
    of, spy = policy(delay=1, late={8: 12})
    targets = run(of, 25)
    assert targets[12:] == pytest.approx([4012] * 13, rel=1e-6)
    assert spy.requests[-1].tick == 24
    np.testing.assert_allclose(spy.requests[-1].actions[-1, 0], 4012 - 24, atol=0.01)
    assert any("its last action is held" in event for event in of.take_events())


def latents() -> LatentActions:
    torch.manual_seed(1)
    size = proprioception_layout(20).size
    states = Normaliser(torch.zeros(size), torch.ones(size))
    actions = Normaliser(torch.tensor(ROBOT.home, dtype=torch.float32), torch.full((20,), 0.1))
    return LatentNetwork(LatentConfig(SIZE, 16, 1), states, actions).to_numpy()


@pytest.fixture
def settings(tmp_path: Path) -> DiffusionSettings:
    """Settings of a small network with random weights that plans latents."""
    torch.manual_seed(0)
    config, path = DenoiserConfig(54, SIZE, width=32, heads=2), tmp_path / "net.safetensors"
    states = Normaliser(torch.zeros(54), torch.ones(54))
    actions = Normaliser(torch.zeros(SIZE), torch.ones(SIZE))
    facts: dict[str, Any] = {"data": "none", "licence": "none", "results": {}, "training": {}}
    weights = Denoiser(config).state_dict()
    trained = checkpoint.Trained(weights, config, states, actions, latents())
    checkpoint.save(path, trained, ROBOT, Origin(**facts))
    return DiffusionSettings(checkpoint=str(path), steps=5, execution_horizon=4, delay=2)


def trace(of: DiffusionPolicy) -> Array:
    of.plans.pace = replace(of.plans.pace, wait=True)
    of.reset(None, np.array(3))
    applied, out = ROBOT.home, []
    for tick in range(13):
        applied = of.act(state(tick), applied, INSTRUCTION)
        out.append(applied)
    return np.stack(out)


@pytest.mark.slow
@pytest.mark.parametrize("schedule", ["full_sequence", "rolling"])
def test_a_checkpoint_with_latents_runs_by_itself(settings: DiffusionSettings, schedule: str) -> None:
    """In line and beside the loop, with nothing but its own file."""
    if schedule == "rolling":
        settings = replace(settings, schedule=schedule, steps=2, execution_horizon=1, delay=1)
    inline, process = (diffusion_policy(ROBOT, settings, process=beside) for beside in (False, True))
    try:
        first = trace(inline)
        np.testing.assert_array_equal(first, trace(process))
    finally:
        process.close()
    plan = inline.plans.latest
    assert plan is not None
    assert plan.actions.shape == (16, SIZE)
    expected = latents().decode(raw_row(state(12)), plan.actions[12 - plan.tick])
    np.testing.assert_array_equal(first[-1], expected)


def test_latents_that_do_not_fit_are_refused(settings: DiffusionSettings) -> None:
    path = Path(settings.checkpoint)
    head, tensors = read(path)
    write(path, {k: v for k, v in tensors.items() if k != "latent.decoder.0.bias"}, head)
    with pytest.raises(CheckpointError, match="latent actions do not fit its own header"):
        diffusion_policy(ROBOT, settings)
    other = head["latent"] | {"state_layout": head["latent"]["state_layout"][1:]}
    write(path, tensors, head | {"latent": other})
    with pytest.raises(CheckpointError, match="latent actions' state layout"):
        diffusion_policy(ROBOT, settings)
    write(path, tensors, {k: v for k, v in head.items() if k != "latent"})
    with pytest.raises(CheckpointError, match="plans 3 numbers a tick, but op3 has 20 joints"):
        diffusion_policy(ROBOT, settings)
    assert read_header(path)["kind"] == "diffusion"

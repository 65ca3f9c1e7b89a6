from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import torch
from synthetic_recording import episode

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, PlanRequest
from servoid.hw.robot.description import load_robot
from servoid.policy.checkpoint import CheckpointError, Origin
from servoid.policy.diffusion.model import checkpoint
from servoid.policy.diffusion.model.config import DenoiserConfig
from servoid.policy.diffusion.model.denoiser import Denoiser
from servoid.policy.diffusion.runtime import Runtime
from servoid.policy.diffusion.settings import DiffusionSettings, GuidanceSettings, load_settings
from servoid.policy.features import Normaliser, raw_layout
from servoid.policy.text.captions import MOTIONS, NAMES, caption
from servoid.policy.text.encoder import code_size, load_encoder
from servoid.policy.text.nearest_phrase import Phrasebook
from servoid.policy.trajectory import Trajectory

ROBOT = load_robot()
SETTINGS = DiffusionSettings(steps=4, delay=2)


def model(seed: int = 0, **shape: Any) -> checkpoint.Model:
    torch.manual_seed(seed)
    config = DenoiserConfig(shape.pop("state_size", 54), 20, **({"width": 32, "heads": 2} | shape))
    denoiser = Denoiser(config).eval().requires_grad_(False)
    states = Normaliser(0.1 * torch.randn(54), torch.rand(54) + 0.1)
    actions = Normaliser(torch.tensor(ROBOT.home, dtype=torch.float32), torch.full((20,), 0.2))
    return checkpoint.Model(denoiser, states, actions, {})


def request(tick: int = 40, delay: int = 2, seed: int = 3) -> PlanRequest:
    raw, _, applied = episode(ROBOT, 60, np.random.default_rng(seed))
    return PlanRequest(tick, raw[37:41], applied[37 : 40 + delay], Instruction(np.array([0.2, 0.0, 0.1])))


def seeded_with(request: PlanRequest, seed: int) -> PlanRequest:
    return replace(request, seeds=np.array(seed))


def moved(states: Array, x: float, y: float, yaw: float) -> Array:
    layout, out = raw_layout(20), states.copy()
    c, s = np.cos(yaw), np.sin(yaw)
    out[:, :2] = states[:, :2] @ np.array([[c, s], [-s, c]]) + [x, y]
    out[:, layout.slice("yaw")] += yaw
    return out


def speed_cost(trajectory: Trajectory, instruction: Instruction) -> Any:
    return (trajectory.velocity[..., 0] - instruction.velocity[0]).square().mean(-1)


def test_the_same_request_and_seed_give_the_same_plan() -> None:
    runtime = Runtime(model(), SETTINGS, ROBOT)
    first, again = runtime.plan(seeded_with(request(), 7)), runtime.plan(seeded_with(request(), 7))
    np.testing.assert_array_equal(first.actions, again.actions)
    np.testing.assert_array_equal(first.states, again.states)
    assert not np.array_equal(first.actions, runtime.plan(seeded_with(request(), 8)).actions)
    assert not np.array_equal(first.actions, runtime.plan(seeded_with(request(tick=41), 7)).actions)


def test_settings_have_actions_guided_and_leave_states_as_they_are() -> None:
    """States see no action, so that theirs is the same plan."""
    guidance = GuidanceSettings(weight=50.0, clip=100.0, gradient="network", scaled=True)
    plans = [
        Runtime(model(), replace(SETTINGS, guidance=replace(guidance, actions=on)), ROBOT, speed_cost).plan(request())
        for on in (False, True)
    ]
    np.testing.assert_array_equal(plans[0].states, plans[1].states)
    assert np.abs(plans[0].actions - plans[1].actions).max() > 1e-4


def test_an_empty_sentence_leaves_the_velocity_untold() -> None:
    pytest.importorskip("wordllama")
    runtime = Runtime(model(text="words", text_size=load_encoder("words").size), SETTINGS, ROBOT)

    def first(text: str | None, velocity: float) -> Array:
        asked = replace(request(), instruction=Instruction(np.array([velocity, 0.0, 0.0]), text=text))
        return runtime.plan(seeded_with(asked, 7)).actions

    assert not np.array_equal(first(None, 0.2), first(None, -0.1))
    assert not np.array_equal(first("", 0.2), first(None, 0.2))
    np.testing.assert_array_equal(first("", 0.2), first("", -0.1))


def test_each_of_a_batch_is_told_the_name_of_its_own_motion() -> None:
    pytest.importorskip("wordllama")
    runtime = Runtime(model(text="words", text_size=load_encoder("words").size), SETTINGS, ROBOT)
    ahead, turning, here = np.array([0.1, 0.0, 0.0]), np.array([0.0, 0.0, 0.6]), request()

    def actions(velocity: Array, text: str | None = None) -> Array:
        n = len(np.atleast_2d(velocity))
        window = np.stack([here.states] * n), np.stack([here.actions] * n), Instruction(velocity, text=text)
        return runtime.plan_batch(*window, [(7, here.tick)] * n)[0]

    both = actions(np.stack([ahead, turning]))
    for one, velocity in zip(both, (ahead, turning), strict=True):
        np.testing.assert_allclose(one, actions(velocity, caption(velocity, ROBOT.walking.scale))[0], atol=1e-6)
    assert not np.allclose(both[0], both[1], atol=1e-3)


@pytest.mark.slow
def test_a_sentence_is_read_as_the_nearest_that_was_trained_with_unless_told_otherwise() -> None:
    pytest.importorskip("wordllama")
    told = "head straight on"  # held out
    known = Phrasebook(load_encoder("words")).familiar(told)
    assert known in MOTIONS[NAMES.index("forward")].phrasings

    def first(text: str, nearest: bool) -> Array:
        settings = replace(SETTINGS, text_nearest=nearest)
        runtime = Runtime(model(text="words", text_size=load_encoder("words").size), settings, ROBOT)
        return runtime.plan(seeded_with(replace(request(), instruction=Instruction(np.zeros(3), text=text)), 7)).actions

    np.testing.assert_array_equal(first(told, True), first(known, True))
    np.testing.assert_array_equal(first(known, True), first(known, False))
    assert not np.array_equal(first(told, False), first(known, False))


def test_committed_actions_are_part_of_the_plan() -> None:
    asked = request(delay=2)
    plan = Runtime(model(), SETTINGS, ROBOT).plan(asked)
    assert plan.tick == 40
    assert plan.actions.shape == (16, 20)
    assert plan.states.shape == (16, raw_layout(20).size)
    np.testing.assert_allclose(plan.actions[:2], asked.actions[3:], atol=1e-6)
    assert np.isfinite(plan.actions).all()
    assert plan.seconds > 0
    # What they are matters for what follows.
    changed = replace(asked, actions=asked.actions + 0.1 * (np.arange(5) >= 3)[:, None])
    assert np.abs(Runtime(model(), SETTINGS, ROBOT).plan(changed).actions[2:] - plan.actions[2:]).max() > 1e-4


def test_a_plan_does_not_depend_on_where_odometry_began() -> None:
    runtime, here = Runtime(model(), SETTINGS, ROBOT), request()
    there = replace(here, states=moved(here.states, 30.0, -20.0, 2.0))
    a, b = runtime.plan(here), runtime.plan(there)
    np.testing.assert_allclose(a.actions, b.actions, atol=1e-4)
    np.testing.assert_allclose(a.path, b.path, atol=1e-4)
    # The predicted rows are in the odometry frame of the request, the path in its heading frame.
    np.testing.assert_allclose(moved(a.states, 30.0, -20.0, 2.0)[:, :4], b.states[:, :4], atol=1e-4)
    c, s = (float(f(here.states[-1, 3])) for f in (np.cos, np.sin))
    offset = (a.states[:, :2] - here.states[-1, :2]) @ np.array([[c, -s], [s, c]])
    np.testing.assert_allclose(a.path, offset, atol=1e-5)


@pytest.mark.parametrize(("gradient", "weight"), [("analytic", 5.0), ("network", 50.0)])
def test_guidance_lowers_the_cost_of_the_prediction(gradient: str, weight: float) -> None:
    guidance = GuidanceSettings(weight=weight, clip=10.0, gradient=gradient)
    asked, velocity = request(), raw_layout(20).slice("velocity")
    plain = Runtime(model(), SETTINGS, ROBOT).plan(asked)
    guided = Runtime(model(), replace(SETTINGS, guidance=guidance), ROBOT, speed_cost).plan(asked)
    error = [np.square(p.states[:, velocity][:, 0] - 0.2).mean() for p in (plain, guided)]
    assert error[1] < 0.8 * error[0]
    assert np.abs(guided.actions[2:] - plain.actions[2:]).max() > 1e-5


def test_a_batch_plans_like_each_of_its_robots() -> None:
    runtime = Runtime(model(), SETTINGS, ROBOT)
    asked = [request(tick=t, seed=t) for t in (40, 41, 42)]
    states, actions = np.stack([r.states for r in asked]), np.stack([r.actions for r in asked])
    targets, _ = runtime.plan_batch(states, actions, asked[0].instruction, [(5, r.tick) for r in asked])
    for together, alone in zip(targets, asked, strict=True):
        np.testing.assert_allclose(together, runtime.plan(seeded_with(alone, 5)).actions, atol=1e-5)


def test_requests_that_cannot_be_planned_are_refused() -> None:
    runtime, asked = Runtime(model(), SETTINGS, ROBOT), request()
    broken = asked.states.copy()
    broken[0, 10] = np.nan
    with pytest.raises(ValueError, match="not finite"):
        runtime.plan(replace(asked, states=broken))
    with pytest.raises(ValueError, match=r"states are \(3, 53\), \(4, 53\) are needed"):
        runtime.plan(replace(asked, states=asked.states[1:]))
    with pytest.raises(ValueError, match="actions are"):
        runtime.plan(replace(asked, actions=asked.actions[:2]))


def test_settings_that_a_network_cannot_serve_are_refused() -> None:
    with pytest.raises(ConfigError, match="lower execution_horizon or delay"):
        Runtime(model(horizon=8), replace(SETTINGS, execution_horizon=7, delay=2), ROBOT)
    with pytest.raises(ConfigError, match="1 to 20"):
        Runtime(model(), replace(SETTINGS, steps=21), ROBOT)
    with pytest.raises(ValueError, match="delay must be 0 to execution_horizon"):
        DiffusionSettings(execution_horizon=2, delay=3)
    with pytest.raises(ValueError, match="gradient"):
        GuidanceSettings(gradient="numeric")


def test_a_delay_that_a_network_was_not_trained_for_is_refused() -> None:
    trained = replace(model(), header={"training": {"committed": 1, "near_actions": 8}})
    with pytest.raises(ConfigError, match="trained for at most 1 ticks"):
        Runtime(trained, SETTINGS, ROBOT)
    Runtime(trained, replace(SETTINGS, delay=1), ROBOT)


def test_the_shipped_settings_load() -> None:
    settings = load_settings()
    assert settings.guidance.weight > 0
    settings.check(DenoiserConfig(54, 20, horizon=16, levels=20))


def test_a_checkpoint_plans_as_what_was_saved(tmp_path: Path) -> None:
    made, path = model(), tmp_path / "net.safetensors"
    facts: dict[str, Any] = {"data": "made up", "licence": "Apache-2.0", "results": {}, "training": {}}
    weights = made.denoiser.state_dict()
    trained = checkpoint.Trained(weights, made.config, made.states, made.actions)
    checkpoint.save(path, trained, ROBOT, Origin(**facts))
    loaded = checkpoint.load(path, ROBOT)
    assert loaded.config == made.config
    a, b = (Runtime(m, SETTINGS, ROBOT).plan(request()) for m in (made, loaded))
    np.testing.assert_array_equal(a.actions, b.actions)
    with pytest.raises(CheckpointError, match=r"joints do not fit.*goes by --policy gait"):
        checkpoint.load(path, replace(ROBOT, joints=ROBOT.joints[1:]))
    del weights["norm.weight"]
    trained = checkpoint.Trained(weights, made.config, made.states, made.actions)
    checkpoint.save(path, trained, ROBOT, Origin(**facts))
    with pytest.raises(CheckpointError, match="do not fit its own header"):
        checkpoint.load(path, ROBOT)


def test_a_checkpoint_whose_encoder_gives_other_codes_now_is_refused(tmp_path: Path) -> None:
    path, size = tmp_path / "net.safetensors", code_size("words")
    facts: dict[str, Any] = {"data": "made up", "licence": "Apache-2.0", "results": {}, "training": {}}

    def load(text: str, text_size: int) -> checkpoint.Model:
        made = model(text=text, text_size=text_size)
        trained = checkpoint.Trained(made.denoiser.state_dict(), made.config, made.states, made.actions)
        checkpoint.save(path, trained, ROBOT, Origin(**facts))
        return checkpoint.load(path, ROBOT)

    assert load("words", size).config.text_size == size
    with pytest.raises(
        CheckpointError, match=rf"as {size - 1} numbers, .* gives {size}: .* commit .* or train it again"
    ):
        load("words", size - 1)
    with pytest.raises(CheckpointError, match="unknown text encoder 'word'"):
        load("word", size)

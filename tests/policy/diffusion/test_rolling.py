from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
import torch
from test_runtime import ROBOT, model, moved, request, seeded_with, speed_cost

from servoid.hw.config import ConfigError
from servoid.hw.contracts.control import Instruction, Keyframes, Plan
from servoid.policy.diffusion.guidance import Diverged
from servoid.policy.diffusion.rolling import Previous, clean_start, frame_noise, renoise, seeded
from servoid.policy.diffusion.runtime import Runtime
from servoid.policy.diffusion.sampler import Known, Sampler
from servoid.policy.diffusion.schedule import Rolling, cosine_signal, rolling
from servoid.policy.diffusion.settings import DiffusionSettings, GuidanceSettings
from servoid.policy.features import Emphasis, Normaliser, raw_layout

ROLLING = DiffusionSettings(schedule="rolling", steps=3, lead=1, execution_horizon=1, delay=1)


def previous_plan(tick: int) -> Plan:
    """A plan that was made at `tick`: what a recorded episode goes on with."""
    later = request(seed=3)
    rng = np.random.default_rng(5)
    states = np.repeat(later.states[-1:], 16, 0)
    states[:, :3] += np.linspace(0, 0.1, 16)[:, None]
    return Plan(tick, later.actions[-1] + 0.1 * rng.standard_normal((16, 20)), states, np.zeros((16, 2)), 0.0)


def test_a_warm_start_is_the_earlier_plan_moved_on_and_seen_from_now() -> None:
    made, asked, plan = model(), request(), previous_plan(37)
    age = asked.tick - plan.tick
    ticks = np.arange(1, len(plan.states) + 1)
    previous = Previous(age, plan.states[None], plan.actions[None], ticks)
    states, actions = clean_start(made.config, made.states, made.actions, previous, asked.states[None, -1])
    # Frame t of now is frame t + age of then; the last ones are new.
    np.testing.assert_allclose(made.actions.decode(actions)[0, 3:16].numpy(), plan.actions[age:], atol=1e-5)
    assert not actions[0, 16:].any()
    assert not states[0, :4].any()
    assert not states[0, 4 + 16 - age :].any()
    heights = made.states.decode(states)[0, 4:17, 4].numpy()
    np.testing.assert_allclose(heights, plan.states[age:, 2], atol=1e-5)
    far = Previous(age, moved(plan.states, 5.0, -3.0, 1.0)[None], plan.actions[None], ticks)
    there, _ = clean_start(made.config, made.states, made.actions, far, moved(asked.states, 5.0, -3.0, 1.0)[None, -1])
    torch.testing.assert_close(there, states, atol=1e-3, rtol=1e-3)


def test_a_frame_keeps_its_noise_when_the_tick_goes_on() -> None:
    config = model().config
    now, later = frame_noise(config, [(7, 40), (8, 40)]), frame_noise(config, [(7, 41), (8, 41)])
    for a, b in zip(now, later, strict=True):
        assert torch.equal(a[:, 1:], b[:, :-1])
        assert not torch.equal(a[0], a[1])
    assert not torch.equal(now[0], frame_noise(config, [(7, 40, 1), (8, 40, 1)])[0])  # another sample


def test_a_plan_goes_on_from_the_one_that_runs_and_is_a_function_of_its_request() -> None:
    runtime, asked = Runtime(model(), ROLLING, ROBOT), request(delay=1)
    warm = replace(asked, previous=previous_plan(39))
    first, again = runtime.plan(seeded_with(warm, 7)), runtime.plan(seeded_with(warm, 7))
    np.testing.assert_array_equal(first.actions, again.actions)
    # What was planned in between does not matter: nothing is kept from one request to the next.
    runtime.plan(seeded_with(replace(asked, tick=41, previous=previous_plan(40)), 7))
    np.testing.assert_array_equal(first.actions, runtime.plan(seeded_with(warm, 7)).actions)
    cold = runtime.plan(seeded_with(asked, 7)).actions
    assert np.abs(first.actions - cold).max() > 1e-3
    other = replace(warm, previous=replace(previous_plan(39), actions=previous_plan(39).actions + 0.05))
    assert np.abs(first.actions[1:] - runtime.plan(seeded_with(other, 7)).actions[1:]).max() > 1e-4
    # A plan that has run out, or that is of another episode, is nothing to go on from.
    np.testing.assert_array_equal(
        cold, runtime.plan(seeded_with(replace(asked, previous=previous_plan(20)), 7)).actions
    )
    np.testing.assert_array_equal(
        cold, runtime.plan(seeded_with(replace(asked, previous=previous_plan(50)), 7)).actions
    )


def test_what_goes_on_from_a_low_level_stays_near_the_plan_that_runs() -> None:
    signal = cosine_signal(20)
    keep = torch.as_tensor(signal, dtype=torch.float32).sqrt()
    frames, generator = np.arange(8), torch.Generator().manual_seed(0)
    noise = torch.randn(200, 8, 1, generator=generator), torch.randn(200, 8, 1, generator=generator)
    nothing = torch.zeros(8, dtype=torch.bool)
    known = Known(torch.zeros(200, 8, 1), torch.zeros(200, 8, 1), nothing, nothing)
    # What the network has learned is spread around 0, and the plan that runs says 2.
    sampler = Sampler(lambda s, a, ks, ka: (s * keep[ks][:, None], a * keep[ka][:, None]), signal)

    def found(state_level: int, action_level: int) -> tuple[float, float]:
        matrix = rolling(20, 4, frames, frames, Rolling(state_level, action_level, ramp=1), fresh=1)
        plan = torch.full((200, 8, 1), 2.0)
        start = renoise((plan, plan), noise, matrix, signal)
        states, actions = sampler.sample(matrix, known, seeds, start=start)
        return states[:, :-1].mean().item(), actions[:, :-1].mean().item()

    seeds = [seeded(i) for i in range(200)]
    state, action = found(14, 4)
    assert 0.5 < state < 1.5
    assert 1.7 < action < 2.1
    state, _ = found(20, 4)
    assert abs(state) < 0.2


def test_other_schedules_do_not_read_the_plan_that_runs() -> None:
    runtime = Runtime(model(), replace(ROLLING, schedule="pyramid"), ROBOT)
    asked = request(delay=1)
    plain, warm = (
        runtime.plan(seeded_with(asked, 7)),
        runtime.plan(seeded_with(replace(asked, previous=previous_plan(39)), 7)),
    )
    np.testing.assert_array_equal(plain.actions, warm.actions)


# -- what a plan can be asked beside ---------------------------------------------------------------------------------


@pytest.mark.parametrize("schedule", ["autoregressive", "pyramid"])
def test_every_schedule_plans_and_a_shorter_horizon_plans_less(schedule: str) -> None:
    settings = DiffusionSettings(
        schedule=schedule, steps=3, history=2, horizon=8, execution_horizon=4, delay=2, stabilization_level=2
    )
    plan = Runtime(model(), settings, ROBOT).plan(request())
    assert plan.actions.shape == (8, 20)
    assert plan.states.shape == (8, raw_layout(20).size)
    assert plan.path.shape == (8, 2)
    assert np.isfinite(plan.actions).all()
    np.testing.assert_allclose(plan.actions[:2], request().actions[3:], atol=1e-6)


def test_a_state_beyond_the_chosen_history_is_not_read() -> None:
    settings = DiffusionSettings(steps=3, history=2)
    runtime, asked = Runtime(model(), settings, ROBOT), request()
    older, recent = asked.states.copy(), asked.states.copy()
    older[0, 2] += 0.1
    recent[2, 2] += 0.1
    plain = runtime.plan(asked).actions
    np.testing.assert_array_equal(plain, runtime.plan(replace(asked, states=older)).actions)
    assert np.abs(plain - runtime.plan(replace(asked, states=recent)).actions).max() > 1e-6


def with_keyframes(*ticks: int, free: tuple[str, ...] = ()) -> tuple[Instruction, np.ndarray]:
    layout, rows = raw_layout(20), np.repeat(request().states[-1:].astype(float), len(ticks), 0)
    rows[:, layout.slice("position")] += 0.2
    rows[:, 0] += 0.05 * np.arange(1, len(ticks) + 1)
    for name in free:
        rows[:, layout.slice(name)] = np.nan
    return Instruction(np.zeros(3), keyframes=Keyframes(np.array(ticks), rows)), rows


@pytest.mark.parametrize("emphasis", [0.0, 5.0])
def test_keyframes_are_met_and_change_what_comes_before(emphasis: float) -> None:
    made = model()
    if emphasis:
        plain = Normaliser(made.states.mean.numpy(), made.states.std.numpy())
        made = replace(model(state_size=108), states=Emphasis.of(plain, 20, emphasis, 0).to_torch())
    runtime, asked = Runtime(made, DiffusionSettings(steps=3), ROBOT), request()
    without = runtime.plan(asked)
    whole, rows = with_keyframes(6, 12, 40)  # the last is beyond the horizon, and comes in later
    plan = runtime.plan(replace(asked, instruction=whole))
    np.testing.assert_allclose(plan.states[[5, 11]], rows[:2], atol=2e-3)
    assert np.abs(plan.states[4] - without.states[4]).max() > 1e-4
    partly, rows = with_keyframes(6, 12, free=("joint_velocity", "velocity", "displacement"))
    plan, joints = runtime.plan(replace(asked, instruction=partly)), raw_layout(20).slice("position")
    np.testing.assert_allclose(plan.states[[5, 11], joints], rows[:, joints], atol=2e-3)
    assert np.isfinite(plan.states).all()
    assert np.abs(plan.states[4] - without.states[4]).max() > 1e-4


def test_keyframes_that_make_no_sense_are_refused() -> None:
    runtime, asked = Runtime(model(), DiffusionSettings(steps=3), ROBOT), request()
    for ticks, match in (((0, 5), "at least 1 and rise"), ((6, 6), "at least 1 and rise")):
        with pytest.raises(ValueError, match=match):
            runtime.plan(replace(asked, instruction=with_keyframes(*ticks)[0]))
    for feature in (0, 1):  # the other would be lost as well, when both are turned into the present heading
        half, rows = with_keyframes(6, 12)
        rows[1, feature] = np.nan
        with pytest.raises(ValueError, match="x and y must both be given or both be free, at tick 12"):
            runtime.plan(replace(asked, instruction=half))
    short = Instruction(np.zeros(3), keyframes=Keyframes(np.array([3]), np.zeros((1, 20))))
    with pytest.raises(ValueError, match=r"states are \(1, 20\) for ticks of \(1,\), \(k, 53\)"):
        runtime.plan(replace(asked, instruction=short))


def test_the_best_of_many_samples_is_run_and_with_the_mean_the_first() -> None:
    def costs(choose: str, samples: int) -> np.ndarray:
        guidance = GuidanceSettings(weight=1e-6, samples=samples, choose=choose)
        runtime = Runtime(model(), DiffusionSettings(steps=3, guidance=guidance), ROBOT, speed_cost)
        velocity = raw_layout(20).slice("velocity")
        plans = [runtime.plan(seeded_with(request(), seed)) for seed in range(5)]
        return np.array([np.square(plan.states[:, velocity][:, 0] - 0.2).mean() for plan in plans])

    one, best = costs("best", 1), costs("best", 4)
    np.testing.assert_allclose(costs("mean", 4), one, rtol=1e-3)
    assert (best <= one * 1.001).all()
    assert (best < 0.99 * one).sum() >= 2


def test_samples_work_in_a_batch_whose_robots_have_their_own_commands() -> None:
    guidance = GuidanceSettings(weight=5.0, samples=3, choose="best")
    asked = [request(tick=t, seed=t) for t in (40, 41)]
    states, actions = np.stack([r.states for r in asked]), np.stack([r.actions for r in asked])
    commands = np.array([[0.2, 0.0, 0.0], [-0.1, 0.0, 0.0]])

    def cost(trajectory: object, instruction: Instruction) -> object:
        asked = torch.as_tensor(instruction.velocity, dtype=torch.float32)[:, None, :1]
        return (trajectory.velocity[..., :1] - asked).square().mean((1, 2))  # type: ignore[attr-defined]

    runtime = Runtime(model(), DiffusionSettings(steps=3, guidance=guidance), ROBOT, cost)
    both, _ = runtime.plan_batch(states, actions, Instruction(commands), [(5, 40), (5, 41)])
    for i in range(2):
        alone, _ = runtime.plan_batch(
            states[i : i + 1], actions[i : i + 1], Instruction(commands[i : i + 1]), [(5, 40 + i)]
        )
        np.testing.assert_allclose(both[i], alone[0], atol=1e-5)


def test_guidance_that_drives_a_plan_out_of_all_bounds_gives_no_plan() -> None:
    guidance = GuidanceSettings(weight=1e6, clip=1e9)
    runtime = Runtime(model(), DiffusionSettings(steps=4, guidance=guidance), ROBOT, speed_cost)
    with pytest.raises(Diverged, match="lower the weight of guidance"):
        runtime.plan(request())


def test_a_checkpoint_that_never_learned_far_actions_does_not_execute_them() -> None:
    made = replace(model(), header={"training": {"far_actions": 0.0, "near_actions": 4}})
    with pytest.raises(ConfigError, match="learned only the actions of the next 4"):
        Runtime(made, DiffusionSettings(steps=4, execution_horizon=4, delay=2), ROBOT)
    Runtime(made, DiffusionSettings(steps=4, execution_horizon=3, delay=1), ROBOT)

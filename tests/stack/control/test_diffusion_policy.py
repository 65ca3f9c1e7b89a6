from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any
from unittest.mock import MagicMock
from weakref import WeakKeyDictionary

import numpy as np
import pytest
import torch

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, Plan, PlanRequest, State
from servoid.hw.robot.description import load_robot
from servoid.policy.checkpoint import Origin
from servoid.policy.diffusion.model import checkpoint
from servoid.policy.diffusion.model.config import DenoiserConfig
from servoid.policy.diffusion.model.denoiser import Denoiser
from servoid.policy.diffusion.settings import DiffusionSettings, GuidanceSettings
from servoid.policy.features import Normaliser, raw_layout
from servoid.stack.control.diffusion import DiffusionPolicy, diffusion_policy
from servoid.stack.control.planning.plan_buffer import Pace
from servoid.stack.control.planning.planner import InlinePlanner, ProcessPlanner
from servoid.stack.control.planning.trim import Trim
from servoid.stack.safety.min_jerk import MinJerk

ROBOT = load_robot()
INSTRUCTION = Instruction(np.array([0.1, 0.0, 0.0]))


def state(tick: int) -> State:
    """Standing; the height tells the tick."""
    return State(
        time_ns=tick * 20_000_000,
        orientation=np.array([1.0, 0, 0, 0]),
        gravity=np.array([0.0, 0, -1]),
        yaw=np.float64(0.0),
        angular_velocity=np.zeros(3),
        velocity=np.zeros(3),
        displacement=np.array([0.0, 0.0, tick / 100]),
        position=ROBOT.home,
        joint_velocity=np.zeros(20),
        contact=np.ones(2),
    )


def marked(asked: PlanRequest) -> Plan:
    """A plan whose action for tick t is 1000 * its own tick + t."""
    actions = 1000.0 * asked.tick + asked.tick + np.arange(16.0)[:, None] * np.ones(20)
    return Plan(asked.tick, actions, np.zeros((16, 53)), np.zeros((16, 2)), 0.0)


class Spy(InlinePlanner):
    """Keeps the requests, and is late for some: for how many calls of `collect` more than one, by tick."""

    def __init__(self, late: dict[int, int] | None = None) -> None:
        super().__init__(marked)
        self.late, self.requests = dict(late or {}), []

    def submit(self, request: PlanRequest) -> None:
        self.requests.append(request)
        super().submit(request)

    def collect(self, tick: int, wait: bool) -> Plan | None:
        self.late[tick] = self.late.get(tick, 0) - 1
        return None if self.late[tick] >= 0 else super().collect(tick, wait)


_ADOPTED: WeakKeyDictionary[DiffusionPolicy, list[tuple[int, int]]] = WeakKeyDictionary()


def act(policy: DiffusionPolicy, at: State, applied: Array, instruction: Instruction) -> Array:
    """Act, and note which plan was adopted."""
    target = policy.act(at, applied, instruction)
    if policy.adopted is not None:
        _ADOPTED.setdefault(policy, []).append((policy.adopted.requested, policy.adopted.adopted))
    return target


def adoptions(policy: DiffusionPolicy) -> list[tuple[int, int]]:
    """Ticks of request and adoption of all plans so far."""
    return _ADOPTED.get(policy, [])


def run(policy: DiffusionPolicy, ticks: int) -> list[float]:
    """Act for so many ticks, the guard accepting everything; the first joint's targets."""
    applied, out = np.full(20, 0.5), []
    for tick in range(ticks):
        applied = act(policy, state(tick), applied, INSTRUCTION)
        out.append(float(applied[0]))
    return out


def test_plans_are_adopted_after_the_delay_and_run_by_tick() -> None:
    policy = DiffusionPolicy(Spy(), Pace(4, 4, 2))
    # The history is full at tick 3; the first request is that of tick 4, adopted at 6; the next, of 8, at 10.
    assert run(policy, 14) == [0.5] * 6 + [4006, 4007, 4008, 4009, 8010, 8011, 8012, 8013]
    assert adoptions(policy) == [(4, 6), (8, 10)]
    assert policy.plans.latest is not None
    assert policy.plans.latest.tick == 8
    assert policy.take_events() == ()


def test_without_delay_a_plan_runs_from_its_own_tick() -> None:
    policy = DiffusionPolicy(Spy(), Pace(4, 4, 0))
    assert run(policy, 9)[3:] == [0.5, 4004, 4005, 4006, 4007, 8008]


def test_requests_hold_what_was_applied_and_what_will_run_meanwhile() -> None:
    planner = Spy()
    policy = DiffusionPolicy(planner, Pace(4, 4, 2))
    targets = run(policy, 13)
    asked = planner.requests[2]
    assert asked.tick == 12
    height = raw_layout(20).slice("displacement").stop - 1
    np.testing.assert_allclose(asked.states[:, height], np.array([9, 10, 11, 12]) / 100, rtol=1e-6)
    # Applied at ticks 9, 10, 11, then what the running plan does at 12 and 13.
    assert asked.actions[:, 0].tolist() == [*targets[9:12], 8012, 8013]


def test_what_the_guard_changed_is_what_the_planner_is_told() -> None:
    planner = Spy()
    policy = DiffusionPolicy(planner, Pace(4, 4, 1))
    for tick in range(5):
        act(policy, state(tick), np.full(20, tick / 10), INSTRUCTION)
    assert planner.requests[0].actions[:3, 0].tolist() == pytest.approx([0.2, 0.3, 0.4])


def test_a_late_plan_is_adopted_when_it_comes_and_the_last_goes_on_until_then() -> None:
    policy = DiffusionPolicy(Spy(late={8: 2}), Pace(4, 4, 1))
    assert run(policy, 15)[8:] == [4008, 4009, 4010, 8011, 8012, 12013, 12014]
    assert adoptions(policy) == [(4, 5), (8, 11), (12, 13)]
    assert policy.take_events() == ("the plan requested at tick 8 was not ready at 9: that of 4 goes on",)
    assert policy.take_events() == ()


def test_nothing_else_is_asked_of_a_planner_that_is_late_and_what_has_passed_is_not_adopted() -> None:
    planner = Spy(late={8: 16})  # the actions of a plan are 16
    policy = DiffusionPolicy(planner, Pace(4, 4, 1))
    assert run(policy, 33)[8:] == [*range(4008, 4020), *[4019] * 9, 28029, 28030, 28031, 28032]
    assert [asked.tick for asked in planner.requests] == [4, 8, 28, 32]
    assert adoptions(policy) == [(4, 5), (28, 29)]


def test_a_machine_that_is_too_slow_walks_by_later_plans_and_says_so() -> None:
    policy = DiffusionPolicy(Spy(late=dict.fromkeys(range(200), 1)), Pace(4, 2, 1))
    targets = run(policy, 80)
    assert adoptions(policy) == [(tick, tick + 2) for tick in range(4, 78, 2)]
    assert targets[10:14] == [8010, 8011, 10012, 10013]
    first, many = policy.take_events()
    assert "requested at tick 4 was not ready at 5" in first
    assert "25 plans in a row were late" in many


def test_a_recorded_run_is_repeated_with_its_late_plans() -> None:
    def walk(planner: Spy, only: dict[int, int] | None) -> tuple[list[float], list[int], tuple[str, ...]]:
        policy = DiffusionPolicy(planner, Pace(4, 2, 1))
        if only is not None:
            policy.repeat(only)
        return run(policy, 60), [asked.tick for asked in planner.requests], policy.take_events()

    late = {8: 2, 14: 1, 20: 16}
    policy = DiffusionPolicy(Spy(late=late), Pace(4, 2, 1))
    run(policy, 60)
    repeated = walk(Spy(), dict(adoptions(policy)))
    assert repeated == walk(Spy(late=late), None)
    assert repeated[0] != walk(Spy(), None)[0]


class FakePipe:
    """The loop's end of a pipe to a process that plans by a clock in ticks, `takes` for the plan of each."""

    def __init__(self, takes: Callable[[int], float]) -> None:
        self.now, self._takes = 0.0, takes
        self._answers: list[tuple[float, object]] = [(0.0, None)]  # when there, and what; the first: it is ready

    def send(self, message: tuple[int, PlanRequest]) -> None:
        serial, asked = message
        assert not self._answers, "it is busy"
        self._answers.append((self.now + self._takes(asked.tick), (serial, marked(asked))))

    def poll(self, timeout: float) -> bool:
        return bool(self._answers) and self._answers[0][0] <= self.now

    def recv(self) -> object:
        return self._answers.pop(0)[1]

    def close(self) -> None: ...


@pytest.mark.parametrize(("replan", "delay", "slow"), [(4, 2, 2.6), (4, 4, 5.2), (2, 2, 2.5), (2, 1, 5.5), (1, 1, 1.3)])
@pytest.mark.parametrize("usual", [0.3, 0.7, 0.95])
def test_planning_goes_on_after_a_slow_plan(replan: int, delay: int, slow: float, usual: float) -> None:
    """The slow one is adopted when it comes, and the next is asked for at the first chance after that."""
    pipe = FakePipe(lambda tick: slow if tick == 20 else usual * delay)
    context = SimpleNamespace(Pipe=lambda: (pipe, MagicMock()), Process=MagicMock())
    policy = DiffusionPolicy(ProcessPlanner(MagicMock(), context=context), Pace(4, replan, delay, wait=False))
    for tick in range(60):
        pipe.now = float(tick)
        act(policy, state(tick), np.full(20, 0.5), INSTRUCTION)
    comes = 20 + math.ceil(slow)
    requested = [tick for tick in range(3, 60 - delay) if tick % replan == 0 and not 20 < tick < comes]
    assert adoptions(policy) == [(tick, comes if tick == 20 else tick + delay) for tick in requested]


def test_what_is_asked_is_corrected_and_has_the_name_of_its_correction() -> None:
    """A name of its own for what was asked would pull against the correction: the planner names what it is asked."""
    spy = Spy()
    policy = DiffusionPolicy(spy, Pace(4, 4, 2), trim=Trim(ROBOT, rate=5.0))
    turning = replace(state(0), angular_velocity=np.array([0.0, 0.0, 0.4]))
    for tick in range(200):
        act(policy, replace(turning, time_ns=tick * 20_000_000), np.full(20, 0.5), INSTRUCTION)
    asked = spy.requests[-1].instruction
    assert asked.velocity[2] < INSTRUCTION.velocity[2] - 0.2
    assert asked.text is None


def test_without_a_plan_it_comes_to_a_stand_and_from_there_goes_on_with_the_next() -> None:
    home = np.full(20, -1.0)
    policy = DiffusionPolicy(Spy(late={8: 16}), Pace(4, 4, 1), stand=lambda pose: MinJerk(pose, home, ticks=4))
    targets = run(policy, 32)
    assert targets[18:20] == [4018, 4019]  # its last actions
    np.testing.assert_allclose(targets[19:23], -1.0 + 4020.0 * (1.0 - np.array([0.0, 0.103515625, 0.5, 0.896484375])))
    assert targets[23] == -1.0
    assert targets[-1] > 8000.0


def test_a_plan_that_is_asked_for_on_the_way_to_a_stand_knows_of_that_way() -> None:
    home = np.full(20, -1.0)
    spy = Spy(late={8: 16})
    policy = DiffusionPolicy(spy, Pace(4, 4, 3), stand=lambda pose: MinJerk(pose, home, ticks=40))
    targets = run(policy, 40)
    standing = [request for request in spy.requests if request.tick > 20 and targets[request.tick] < 4019.0]
    assert standing
    for request in standing:
        np.testing.assert_allclose(request.actions[-3, 0], targets[request.tick])
        if targets[request.tick + 2] < targets[request.tick]:  # no other plan has come by then
            np.testing.assert_allclose(request.actions[-3:, 0], targets[request.tick : request.tick + 3])


def test_the_last_action_is_held_when_plans_stop_coming_and_it_is_said_once() -> None:
    policy = DiffusionPolicy(Spy(late={8: 100}), Pace(4, 4, 1))
    assert run(policy, 24)[18:] == [4018, 4019, 4019, 4019, 4019, 4019]
    ended = [text for text in policy.take_events() if "ended before another one came" in text]
    assert ended == ["the plan of tick 4 ended before another one came: its last action is held"]


def test_a_request_holds_the_plan_that_runs() -> None:
    planner = Spy()
    policy = DiffusionPolicy(planner, Pace(4, 1, 1))
    run(policy, 8)
    previous = [None if r.previous is None else r.previous.tick for r in planner.requests]
    assert [r.tick for r in planner.requests] == [3, 4, 5, 6, 7]
    assert previous == [None, 3, 4, 5, 6]
    policy.reset(None, np.array(1))
    run(policy, 4)
    assert planner.requests[-1].previous is None


class Refusing(Spy):
    """Finds no plan for some ticks."""

    def collect(self, tick: int, wait: bool) -> Plan | None:
        plan = super().collect(tick, wait)
        if plan is None or tick not in (8, 12, 20):
            return plan
        nothing = np.full((1, 1), np.nan)
        return Plan(tick, nothing, nothing, nothing, 0.0, "guidance diverged")


def test_a_plan_that_could_not_be_made_is_said_once_and_the_last_goes_on() -> None:
    policy = DiffusionPolicy(Refusing(), Pace(4, 4, 1))
    assert run(policy, 18)[8:] == [*range(4008, 4017), 16017]
    assert policy.take_events() == ("no plan for tick 8: guidance diverged: that of 4 goes on",)
    assert adoptions(policy) == [(4, 5), (16, 17)]
    applied = np.zeros(20)
    for tick in range(18, 22):
        applied = act(policy, state(tick), applied, INSTRUCTION)
    assert policy.take_events() == ("no plan for tick 20: guidance diverged: that of 16 goes on",)


def test_reset_forgets_the_episode() -> None:
    policy = DiffusionPolicy(Spy(), Pace(4, 4, 1))
    first = run(policy, 12)
    policy.reset(None, np.array(1))
    assert policy.adopted is None
    assert run(policy, 12) == first


def slow_down(trajectory: Any, instruction: Instruction) -> Any:
    return trajectory.velocity.square().sum((-1, -2))


@pytest.fixture
def settings(tmp_path: Path) -> DiffusionSettings:
    return untrained(tmp_path)


def untrained(tmp_path: Path, **training: Any) -> DiffusionSettings:
    """Settings of a small network with random weights, whose header says of its `training` what is given."""
    torch.manual_seed(0)
    config, path = DenoiserConfig(54, 20, width=32, heads=2), tmp_path / "net.safetensors"
    states = Normaliser(torch.zeros(54), torch.ones(54))
    actions = Normaliser(torch.tensor(ROBOT.home, dtype=torch.float32), torch.full((20,), 0.1))
    facts: dict[str, Any] = {"data": "none", "licence": "none", "results": {}, "training": training}
    trained = checkpoint.Trained(Denoiser(config).state_dict(), config, states, actions)
    checkpoint.save(path, trained, ROBOT, Origin(**facts))
    return DiffusionSettings(checkpoint=str(path), steps=5, execution_horizon=4, delay=2)


def trace(policy: DiffusionPolicy, seed: int, wait: bool) -> Array:
    policy.plans.pace = replace(policy.plans.pace, wait=wait)
    policy.reset(None, np.array(seed))
    applied, out = ROBOT.home, []
    for tick in range(13):
        applied = act(policy, state(tick), applied, INSTRUCTION)
        out.append(applied)
    return np.stack(out)


def test_in_line_and_beside_the_loop_a_seed_gives_the_same_actions(settings: DiffusionSettings) -> None:
    inline = diffusion_policy(ROBOT, settings, slow_down)
    process = diffusion_policy(ROBOT, settings, slow_down, process=True)
    try:
        first = trace(inline, 3, wait=True)
        np.testing.assert_array_equal(first, trace(inline, 3, wait=True))
        np.testing.assert_array_equal(first, trace(process, 3, wait=True))
        assert adoptions(process) == [(4, 6), (8, 10)]
        assert not np.array_equal(first, trace(inline, 4, wait=True))
    finally:
        process.close()


def beyond(trajectory: Any, instruction: Instruction) -> Any:
    return trajectory.velocity.square().sum((-1, -2))


@pytest.mark.parametrize("process", [False, pytest.param(True, marks=pytest.mark.slow)])
def test_a_guidance_weight_that_diverges_holds_the_robot_and_says_why(
    settings: DiffusionSettings, process: bool
) -> None:
    wild = replace(settings, guidance=GuidanceSettings(weight=1e9, clip=1e12))
    policy = diffusion_policy(ROBOT, wild, beyond, process=process)
    try:
        targets = trace(policy, 3, wait=True)
    finally:
        policy.close()
    np.testing.assert_array_equal(targets, np.repeat(ROBOT.home[None], len(targets), 0))
    (event,) = policy.take_events()
    assert "the goal is held" in event
    assert "lower" in event


@pytest.mark.parametrize("process", [False, True])
def test_a_checkpoint_for_another_rate_is_refused_before_anything_starts(
    settings: DiffusionSettings, process: bool
) -> None:
    with pytest.raises(ConfigError, match="runs at 100"):
        diffusion_policy(replace(ROBOT, rate=100), settings, process=process)
    with pytest.raises(ConfigError, match="lower execution_horizon or delay"):
        diffusion_policy(ROBOT, replace(settings, execution_horizon=15, delay=2), process=process)
    with pytest.raises(ConfigError, match="horizon is 32"):
        diffusion_policy(ROBOT, replace(settings, horizon=32), process=process)


@pytest.mark.parametrize("process", [False, True])
def test_settings_that_the_training_does_not_fit_are_refused_before_anything_starts(
    tmp_path: Path, process: bool
) -> None:
    with pytest.raises(ConfigError, match="trained for at most 1 ticks"):
        diffusion_policy(ROBOT, untrained(tmp_path, committed=1), process=process)
    with pytest.raises(ConfigError, match="learned only the actions of the next 5"):
        diffusion_policy(ROBOT, untrained(tmp_path, far_actions=0.0, near_actions=5), process=process)


def test_plans_that_take_no_time_are_for_simulation_only(settings: DiffusionSettings) -> None:
    with pytest.raises(ConfigError, match="in real time set delay to 1 or more"):
        diffusion_policy(ROBOT, replace(settings, delay=0), process=True)


@pytest.mark.slow
def test_rolling_gives_the_same_actions_in_line_and_beside_the_loop(settings: DiffusionSettings) -> None:
    rolling = replace(settings, schedule="rolling", steps=2, execution_horizon=1, delay=1)
    inline, process = diffusion_policy(ROBOT, rolling), diffusion_policy(ROBOT, rolling, process=True)
    try:
        first = trace(inline, 3, wait=True)
        np.testing.assert_array_equal(first, trace(process, 3, wait=True))
        np.testing.assert_array_equal(first, trace(inline, 3, wait=True))  # a new episode starts afresh
        assert adoptions(inline)[:2] == [(3, 4), (4, 5)]
    finally:
        process.close()

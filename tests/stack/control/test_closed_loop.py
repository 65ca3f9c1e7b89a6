"""Planning in a closed loop: what a plan goes on from, when it is asked for and adopted, and that a run is repeated."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from made_planner import write_planner

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, PlanRequest
from servoid.hw.robot.description import load_robot
from servoid.policy.diffusion.prefix.frames import Frames
from servoid.policy.diffusion.prefix.model import load
from servoid.policy.diffusion.prefix.runtime import PlannerRuntime
from servoid.policy.features import raw_layout
from servoid.policy.references.plan import PlanReference, row_layout
from servoid.stack.control.closed_loop import ClosedLoopSettings, closed_loop_policy, load_settings
from servoid.stack.control.fleet import Fleet
from servoid.stack.control.policies import make_policy, policy_fingerprint
from servoid.stack.control.tracker import walks
from servoid.stack.tasks import load_task

ROBOT = load_robot("op3")
FRAMES = Frames(ROBOT)
STILL = Instruction(np.zeros(3), text="wave")


@pytest.fixture(scope="module")
def checkpoint(tmp_path_factory: pytest.TempPathFactory) -> str:
    return write_planner(tmp_path_factory.mktemp("planner") / "planner.safetensors", ROBOT)


def _settings(checkpoint: str, **changes: object) -> ClosedLoopSettings:
    return replace(ClosedLoopSettings(checkpoint=checkpoint, frames=6, delay=4), **changes)  # type: ignore[arg-type]


def _request(tick: int = 0, **changes: object) -> PlanRequest:
    layout = raw_layout(len(ROBOT.joints))
    states = np.zeros((9, layout.size))
    states[:, layout.slice("displacement")] = [0.5, 0.2, ROBOT.standing_height]
    states[:, layout.slice("yaw")] = 0.7
    states[:, layout.slice("gravity")] = [0.0, 0.0, -1.0]
    states[:, layout.slice("position")] = ROBOT.home
    request = PlanRequest(tick, states, np.zeros((8, len(ROBOT.joints))), STILL)
    return replace(request, **changes)  # type: ignore[arg-type]


def _runtime(checkpoint: str, **changes: object) -> PlannerRuntime:
    settings = _settings(checkpoint, **changes)
    return PlannerRuntime(load(Path(checkpoint), ROBOT, FRAMES), ROBOT, FRAMES, settings)


def test_a_plan_begins_where_the_robot_will_be_and_says_so_tick_by_tick(checkpoint: str) -> None:
    plan = _runtime(checkpoint).plan(_request())
    rows, layout = plan.actions, row_layout(ROBOT)
    assert rows.shape == (4 + 12, layout.size)
    assert plan.states.shape == (6, FRAMES.layout.size)
    assert plan.ticks is not None
    assert plan.ticks.tolist() == [6, 8, 10, 12, 14, 16]
    assert plan.path.shape == (6, 2)
    np.testing.assert_allclose(rows[4, layout.slice("place")], [0.5, 0.2, ROBOT.standing_height], atol=0.02)
    whole = FRAMES.to_global(plan.states)
    every = rows[5::2]  # two ticks a frame, after the first half of the first one
    np.testing.assert_allclose(
        every[:, layout.slice("position")], np.clip(whole.joints, ROBOT.lower, ROBOT.upper), atol=1e-6
    )


def test_the_prefix_is_what_was_executed_and_then_what_runs_meanwhile(checkpoint: str) -> None:
    first = _runtime(checkpoint).plan(_request())
    ran = _request(12, previous=first)
    closed, other = (_runtime(checkpoint, feedback=feedback) for feedback in (True, False))
    bent = ran.states.copy()
    bent[:, raw_layout(len(ROBOT.joints)).slice("position")] += 0.05
    moved = replace(ran, states=bent)
    assert not np.allclose(closed.plan(ran).states, closed.plan(moved).states, atol=1e-5)
    np.testing.assert_allclose(other.plan(ran).states, other.plan(moved).states, atol=1e-6)  # open loop
    coming = replace(first, states=first.states + 0.02)
    assert not np.allclose(closed.plan(ran).states, closed.plan(replace(ran, previous=coming)).states, atol=1e-5)


def test_velocity_goal_and_targets_change_a_plan_and_a_far_goal_is_asked_for_in_steps(checkpoint: str) -> None:
    runtime = _runtime(checkpoint)

    def plan(instruction: Instruction) -> Array:
        return runtime.plan(_request(instruction=instruction)).states

    still = Instruction(np.zeros(3))
    told = [
        still,
        Instruction(np.array([0.2, 0.0, 0.0])),
        Instruction(np.zeros(3), goal=np.array([0.2, 0.0])),
        Instruction(np.zeros(3), targets={"left hand": np.array([0.1, 0.1, 0.3])}),
        STILL,
    ]
    plans = [plan(instruction) for instruction in told]
    assert all(not np.allclose(a, b, atol=1e-5) for i, a in enumerate(plans) for b in plans[:i])
    far, further = (plan(Instruction(np.zeros(3), goal=np.array([x, 0.0]))) for x in (2.0, 3.0))
    np.testing.assert_allclose(far, further, atol=1e-6)
    with pytest.raises(ConfigError, match="tail"):
        plan(Instruction(np.zeros(3), targets={"tail": np.zeros(3)}))
    with pytest.raises(ConfigError, match="not finite: was it seen"):
        plan(Instruction(np.zeros(3), targets={"left hand": np.full(3, np.nan)}))
    with pytest.raises(ConfigError, match=r"no part reaches 0\.90 m up, where .left hand. shall be; 0\.57 m at most"):
        plan(Instruction(np.zeros(3), targets={"left hand": np.array([0.1, 0.0, 0.9])}))
    with pytest.raises(ConfigError, match="no English word"):
        plan(Instruction(np.zeros(3), text="???"))


def test_a_velocity_that_leads_to_a_goal_is_planned_for_no_further_than_it(checkpoint: str) -> None:
    runtime = _runtime(checkpoint)

    def plan(velocity: tuple[float, float, float], **asked: object) -> Array:
        return runtime.plan(_request(instruction=Instruction(np.array(velocity), **asked))).states  # type: ignore[arg-type]

    ahead = (0.2, 0.0, 0.0)
    far, further, none = plan(ahead, goal=np.array([2.0, 0.0])), plan(ahead, goal=np.array([3.0, 0.0])), plan(ahead)
    np.testing.assert_allclose(far, further, atol=1e-6)
    np.testing.assert_allclose(far, none, atol=1e-6)
    assert not np.allclose(far, plan(ahead, goal=np.array([0.03, 0.0])), atol=1e-5)
    turning = (0.0, 0.0, 0.8)
    beside, aside = (plan(turning, goal=np.array([1.0, y])) for y in (0.02, 3.0))
    assert not np.allclose(beside, aside, atol=1e-5), "it faces the goal, and turns no further"
    targets = [{"heading": np.array(angle)} for angle in (2.0, 3.0, 0.2)]
    most, more, less = (plan((0.0, 0.0, 0.0), targets=asked) for asked in targets)
    np.testing.assert_allclose(most, more, atol=1e-6)
    assert not np.allclose(most, less, atol=1e-5)


def test_many_that_are_asked_for_different_things_plan_as_each_does_alone(checkpoint: str) -> None:
    runtime, one = _runtime(checkpoint), _request()
    asked = [
        STILL,
        Instruction(np.array([0.2, 0.0, 0.0])),
        Instruction(np.zeros(3), text="kick", targets={"left hand": np.array([0.1, 0.1, 0.3])}),
        Instruction(np.zeros(3), stand=True),
    ]
    many = replace(one, states=np.repeat(one.states[None], 4, 0), seeds=np.zeros(4, int))
    together = runtime.plan(many, asked)
    for plan, instruction in zip(together.actions, asked, strict=True):
        np.testing.assert_allclose(plan, runtime.plan(replace(one, instruction=instruction)).actions, atol=1e-5)


def test_a_sentence_is_read_as_the_nearest_of_the_training(checkpoint: str) -> None:
    """So that one that no training saw asks for a motion all the same."""
    nearest, plain = _runtime(checkpoint), _runtime(checkpoint, text_nearest=False)
    told, meant = (_request(instruction=Instruction(np.zeros(3), text=text)) for text in ("wave now", "wave"))
    np.testing.assert_array_equal(nearest.plan(told).states, nearest.plan(meant).states)
    np.testing.assert_array_equal(plain.plan(meant).states, nearest.plan(meant).states)
    assert not np.allclose(plain.plan(told).states, plain.plan(meant).states, atol=1e-5)


def test_only_what_steps_with_both_feet_is_followed_as_a_walk() -> None:
    """A punch turns the trunk as fast as a slow turn does; a follower of the gait topples over where it is told to."""
    layout, reference = row_layout(ROBOT), PlanReference(ROBOT)
    angle = 0.3 * np.arange(60) * ROBOT.dt / 2
    rows = np.zeros((60, layout.size))
    rows[:, layout.slice("place")] = [0.0, 0.0, ROBOT.standing_height]
    rows[:, layout.slice("orientation")] = np.stack([np.cos(angle), 0 * angle, 0 * angle, np.sin(angle)], -1)
    rows[:, layout.slice("position")] = ROBOT.home
    rows[:, layout.slice("contact")] = 1.0
    for lifted, is_walk in (((), False), ((0,), False), ((0, 1), True)):
        turning = rows.copy()
        for foot in lifted:
            turning[5 + 12 * foot : 12 + 12 * foot, layout.slice("contact").start + foot] = 0.0
        reference.follow(turning)
        assert walks(reference, ROBOT) == is_walk


def test_another_sentence_is_planned_for_at_once_and_a_run_is_repeated(checkpoint: str) -> None:
    def run() -> tuple[Array, list[int]]:
        policy = closed_loop_policy(ROBOT, _settings(checkpoint))
        policy.reset(None, np.array(3))
        state = Fleet(ROBOT, 1, None, seed=0)
        state.reset(np.ones(1, bool))
        targets, requested = [], []
        for tick in range(40):
            seen = state.observe()
            one = type(seen)(seen.time_ns, *(getattr(seen, name)[0] for name in list(seen.__slots__)[1:]))
            told = STILL if tick < 15 else Instruction(np.zeros(3), text="kick")
            target = policy.act(one, state.applied[0], told)
            state.step(target[None])
            targets.append(target)
            if policy.adopted is not None:
                requested.append(policy.adopted.requested)
        policy.close()
        return np.array(targets), requested

    (targets, requested), (again, _) = run(), run()
    assert requested == [0, 12, 16, 24], "at 12 ticks, and besides at the first frame after the sentence changed"
    np.testing.assert_array_equal(targets, again)
    np.testing.assert_allclose(targets[:4], np.tile(ROBOT.home, (4, 1)), atol=1e-6)  # held until the first plan
    assert np.abs(targets[5:] - ROBOT.home).max() > 1e-4


def test_what_cannot_be_understood_is_said_and_the_last_plan_goes_on(checkpoint: str) -> None:
    policy, fleet = closed_loop_policy(ROBOT, _settings(checkpoint), shape=(1,)), Fleet(ROBOT, 1, None, seed=0)
    fleet.reset(np.ones(1, bool))
    policy.reset(None, np.zeros(1, int))
    events: list[str] = []
    for tick in range(26):
        told = Instruction(np.zeros((1, 3)), text="wave" if tick < 14 else "???")
        fleet.step(policy.act(fleet.observe(), fleet.applied, told))
        events += policy.take_events()
    assert any("no English word" in event and "goes on" in event for event in events)


def test_worlds_of_many_plan_together(checkpoint: str) -> None:
    policy, fleet = closed_loop_policy(ROBOT, _settings(checkpoint), shape=(3,)), Fleet(ROBOT, 3, None, seed=0)
    fleet.reset(np.ones(3, bool))
    policy.reset(None, np.arange(3))
    for tick in range(20):
        if tick == 14:
            policy.reset(np.array([False, True, False]), np.array([0, 9, 0]))
            fleet.reset(np.array([False, True, False]))
        targets = policy.act(fleet.observe(), fleet.applied, Instruction(np.zeros((3, 3))))
        fleet.step(targets)
        assert np.isfinite(targets).all()
        if tick == 14:
            np.testing.assert_allclose(targets[1], fleet.applied[1], atol=0.05)
    assert not np.allclose(targets[0], targets[2])


@pytest.mark.parametrize(
    ("changes", "message"),
    [
        ({"delay": 3}, "multiple of the 2 ticks"),
        ({"delay": 14}, "at most the 12 ticks"),
        ({"steps": 9}, "at most the network's 5"),
    ],
)
def test_settings_that_cannot_be_are_refused(checkpoint: str, changes: dict[str, object], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        closed_loop_policy(ROBOT, _settings(checkpoint, **changes))


def test_without_a_planner_it_says_how_to_train_one() -> None:
    with pytest.raises(ConfigError, match="servoid train planner"):
        closed_loop_policy(ROBOT, _settings("nowhere"))


def test_it_is_found_by_its_settings_and_by_its_checkpoint(checkpoint: str, tmp_path: Path) -> None:
    task = load_task("stand", {}, ROBOT.dt)
    assert load_settings().frames == 20
    policy = make_policy(checkpoint, ROBOT, task, False)
    policy.close()
    assert policy_fingerprint(checkpoint)["closed_loop"]["feedback"] is True
    mine = tmp_path / "mine.yaml"
    mine.write_text(f"checkpoint: {checkpoint}\ntracker: ''\nfeedback: false\nframes: 20\n")
    assert policy_fingerprint(str(mine))["closed_loop"]["frames"] == 20

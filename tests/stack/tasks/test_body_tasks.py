"""Tasks about parts of the body: a hand that touches a ball in the air, a robot that passes under a bar."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from task_bodies import DT, Drawn, moves, state

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.task import Trace
from servoid.hw.contracts.world import SceneObject
from servoid.hw.robot.description import load_robot
from servoid.stack.runtime.run import RunSettings, prepare, run
from servoid.stack.tasks import load_task
from servoid.stack.tasks.body import build_of, lowest_top
from servoid.stack.tasks.terms.body import limb_ends
from servoid.tools.common.ground_truth import GroundTruth
from servoid.tools.evaluate.judge import judge, simulation

ROBOT = load_robot()
ARM = build_of(ROBOT).limbs["right hand"]


def stands(places: Array, height: float, ball: Array, joints: Array = ROBOT.home) -> Trace:
    """A robot at `places` `(ticks, 2)`, facing along x, and an object that stays where it is."""
    ticks = len(places)
    zeros = np.zeros((ticks, 3))
    return Trace(
        dt=DT,
        displacement=np.column_stack([places, np.full(ticks, height)]),
        yaw=np.zeros(ticks),
        velocity=zeros,
        yaw_rate=np.zeros(ticks),
        command=zeros,
        fallen=False,
        joints=np.tile(joints, (ticks, 1)),
        orientation=np.tile([1.0, 0.0, 0.0, 0.0], (ticks, 1)),
        objects=np.tile([*ball, 1.0, 0.0, 0.0, 0.0], (ticks, 1, 1)),
        touched=False,
    )


def test_a_hand_has_touched_a_ball_when_it_was_inside_by_the_joints() -> None:
    task = Drawn(load_task("reach-hand", {}, DT))
    hand = limb_ends(ARM, np.array([0.5, 0.0, 0.26]), np.array(0.0), np.array([0.0, 0.0, -1.0]), ROBOT.home)
    walk = np.column_stack([np.linspace(0.0, 0.6, 31), np.zeros(31)])
    assert task.success(stands(walk, 0.26, hand))
    assert task.metrics(stands(walk, 0.26, hand))["seconds_to_touch"] == pytest.approx(0.48, abs=0.06)
    assert not task.success(stands(walk, 0.26, hand + np.array([0.0, 0.0, 0.05])))
    raised = ROBOT.home.copy()
    raised[ROBOT.names.index("r_sho_pitch")] += 1.0
    assert not task.success(stands(walk[24:27], 0.26, hand, raised)), "the arm was elsewhere"
    assert not task.success(stands(np.zeros((0, 2)), 0.26, hand))


def test_a_hand_is_asked_for_where_the_ball_is_seen_from_here() -> None:
    task = Drawn(load_task("reach-hand", {"hand": "left", "way": "cost"}, DT), 3)
    here = state(0.2, 0.1, 0.5)
    asked = task.instruct(0, here, task.percept(here))
    (ball,) = task.scene.objects
    away = np.array(ball.place) - [0.2, 0.1]
    turn = np.array([[np.cos(0.5), np.sin(0.5)], [-np.sin(0.5), np.cos(0.5)]])
    np.testing.assert_allclose(asked.targets["left hand"], [*(turn @ away), ball.height])
    assert asked.text == ""
    cost = task.objective
    walk = moves(np.zeros((4, 2)))
    slope = cost.slope(walk, asked)[1]
    arm = list(build_of(ROBOT).limbs["left hand"].joints)
    assert np.abs(slope["joints"][..., arm]).max() > 1e-3
    assert not np.delete(slope["joints"], arm, axis=-1).any()
    nearer = replace(walk, displacement=walk.displacement + 0.1 * (turn @ away) / np.linalg.norm(away))
    assert cost(nearer, asked) < cost(walk, asked)


def test_a_ball_out_of_reach_is_refused() -> None:
    for height in ("0.1", "0.2:0.7"):
        with pytest.raises(
            ConfigError, match=r"height=0\.[17]: the right hand of op3 comes to between 0\.17 m and .* out"
        ):
            load_task("reach-hand", {"height": height})


def test_a_bar_lower_than_the_robot_can_crouch_is_refused() -> None:
    lowest = lowest_top(ROBOT, build_of(ROBOT))
    assert 0.8 * 0.484 < lowest < 0.9 * 0.484
    load_task("crouch-under", {"height": f"{lowest + 0.001}"})
    with pytest.raises(ConfigError, match=rf"is lower than op3 can crouch: .* {lowest:.3f} m at best"):
        load_task("crouch-under", {"height": f"{lowest - 0.001}:0.5"})


def test_who_goes_around_a_bar_or_touches_it_has_not_passed_under() -> None:
    task = Drawn(load_task("crouch-under", {}, DT))
    (bar,) = task.scene.objects
    middle = np.array([*bar.place, bar.height])
    under = np.column_stack([np.linspace(0.0, 1.0, 60), np.zeros(60)])
    assert task.success(stands(under, 0.25, middle))
    assert task.metrics(stands(under, 0.25, middle))["base_beneath_m"] == pytest.approx(0.25)
    aside = under + np.column_stack([np.zeros(60), 0.7 * np.sin(np.linspace(0.0, np.pi, 60))])
    assert not task.success(stands(aside, 0.25, middle))
    assert not task.success(replace(stands(under, 0.25, middle), touched=True))
    assert not task.success(stands(under[:40], 0.25, middle))


def test_a_robot_that_cannot_feel_a_bar_believes_that_it_hit_it_where_it_was_too_tall_beneath() -> None:
    task = Drawn(load_task("crouch-under", {}, DT))
    (bar,) = task.scene.objects
    middle, top = np.array([*bar.place, bar.height]), build_of(ROBOT).top
    under = np.column_stack([np.linspace(0.0, 1.0, 60), np.zeros(60)])
    tall, low = (replace(stands(under, bar.lift - top + off, middle), touched=None) for off in (0.005, -0.005))
    assert task.metrics(tall)["touched"] == 1.0
    assert not task.success(tall)
    assert task.metrics(low)["touched"] == 0.0
    assert task.success(low)


def test_a_bar_costs_height_beneath_it_and_nothing_elsewhere() -> None:
    task = Drawn(load_task("crouch-under", {"way": "cost", "alone.goal": "0", "alone.facing": "0"}, DT))
    here = state()
    asked = task.instruct(0, here, task.percept(here))
    (bar,) = task.scene.objects
    places = np.array([[0.0, 0.0], [bar.place[0], 0.0], [bar.place[0], 0.8]])
    slopes = []
    for place in places:
        tall = moves(np.tile(place, (2, 1)))
        slopes.append(task.objective.slope(replace(tall, height=tall.height + 0.259), asked)[1]["height"].sum())
    assert slopes[1] > 0.1
    assert slopes[0] == slopes[2] == 0.0
    low = moves(np.tile(places[1], (2, 1)))
    assert task.objective(replace(low, height=low.height + bar.lift - 0.25), asked) == 0.0


def test_what_is_movable_cannot_hang_in_the_air() -> None:
    with pytest.raises(ValueError, match=r"lift: a ball cannot be 0\.2 m above the ground"):
        SceneObject("ball", (0.0, 0.0), (0.1, 0.1, 0.1), 0.1, lift=0.2)


@pytest.mark.slow
@pytest.mark.parametrize(("name", "settings"), [("reach-hand", {"hand": "left"}), ("crouch-under", {"height": "0.51"})])
def test_the_script_reaches_a_ball_at_its_hand_and_passes_a_bar_above_its_head(
    name: str, settings: dict[str, str]
) -> None:
    chosen = RunSettings(name, policy="gait", seed=1, seconds=20.0, set=settings)
    task, body = prepare(chosen)
    truth = GroundTruth(simulation(body), DT)
    assert run(chosen, backend=body, on_tick=truth).outcome == "succeeded"
    assert task.success(truth.trace())


@pytest.mark.slow
def test_a_head_that_meets_a_bar_is_felt() -> None:
    row = judge(RunSettings("crouch-under", policy="gait", seconds=8.0, set={"height": "0.44", "ahead": "0.3"})).row
    assert row["metrics"]["touched"] == 1.0
    assert not row["success"]

"""The terms of the guidance cost: what each wants, and where its gradient points."""

from __future__ import annotations

import pickle
from dataclasses import replace
from functools import partial

import numpy as np
import pytest
import torch
from task_bodies import DT, Drawn, moves, state

from servoid.hw.contracts.control import DistanceMap, Instruction, State
from servoid.hw.geometry import to_heading
from servoid.policy.features import Trajectory
from servoid.stack.navigation.potential_field import FieldSettings, PotentialField
from servoid.stack.tasks import load_settings, load_task
from servoid.stack.tasks.terms.guidance import (
    Stopping,
    Weights,
    goal_cost,
    ground_cost,
    obstacle_cost,
    path_cost,
    total_cost,
    way_cost,
)

TWIST = tuple(f"cost.{name}" for name in ("velocity", "yaw_rate", "displacement", "yaw", "stand"))


def value(cost: torch.Tensor) -> float:
    return float(cost.detach())


def test_obstacle_cost_is_the_papers_and_pushes_away() -> None:
    here = moves(np.zeros((4, 2)))
    obstacle = np.array([[0.3, 0.0, 0.05, 0.0, 0.0]])
    cost = obstacle_cost(here, obstacle, Weights(repulsion=2.0, sharpness=10.0))
    assert value(cost) == pytest.approx(2.0 * np.exp(-10.0 * 0.25), rel=1e-4)
    (gradient,) = torch.autograd.grad(cost.sum(), here.displacement)
    assert (gradient[0, :, 0] > 0).all()  # a step down it goes back
    assert (gradient[0, :, 1] == 0).all()
    soft = obstacle_cost(here, obstacle, Weights(repulsion=0.0, avoidance=1.0, margin=0.25))
    assert value(soft) == pytest.approx(np.log(2.0), rel=1e-4)


def test_obstacle_cost_meets_a_moving_obstacle_where_it_will_be() -> None:
    horizon = 25
    still = moves(np.zeros((horizon, 2)))
    coming, leaving = np.array([[0.5, 0, 0.1, -0.4, 0]]), np.array([[0.5, 0, 0.1, 0.4, 0]])
    weights = Weights(repulsion=1.0)
    assert obstacle_cost(still, coming, weights) > 5 * obstacle_cost(still, leaving, weights)
    at_end = 0.5 - 0.4 * DT * horizon
    alone = obstacle_cost(moves(np.zeros((1, 2))), np.array([[at_end + 0.4 * DT, 0, 0.1, -0.4, 0]]), weights)
    assert value(alone) == pytest.approx(np.exp(-15 * (at_end - 0.1)), rel=1e-4)


def test_a_body_has_a_width_across_its_heading_and_is_thin_along_it() -> None:
    weights = Weights(repulsion=1.0, sharpness=10.0, width=0.17, depth=0.05)
    ahead, beside = (np.array([[x, y, 0.05, 0.0, 0.0]]) for x, y in ((0.3, 0.0), (0.0, 0.3)))
    here, turned = moves(np.zeros((2, 2))), moves(np.zeros((2, 2)), yaw=np.pi / 2)
    assert value(obstacle_cost(here, ahead, weights)) == pytest.approx(np.exp(-10 * 0.2), rel=1e-3)
    assert value(obstacle_cost(here, beside, weights)) == pytest.approx(np.exp(-10 * 0.08), rel=1e-3)
    assert value(obstacle_cost(turned, ahead, weights)) == pytest.approx(np.exp(-10 * 0.08), rel=1e-3)
    slanting = moves(np.zeros((2, 2)), yaw=0.3)
    slanting.yaw.requires_grad_()
    (gradient,) = torch.autograd.grad(obstacle_cost(slanting, beside, weights).sum(), slanting.yaw)
    assert (gradient < 0).all()  # turned further, its side is further from what stands beside it
    with pytest.raises(ValueError, match=r"depth: 0.2 must not be more than width \(0.1\)"):
        Weights(width=0.1, depth=0.2)


def test_repulsion_ends_at_the_safe_distance_and_does_not_grow_inside() -> None:
    weights = Weights(repulsion=1.0, sharpness=10.0, safe=0.2)
    costs = [
        value(obstacle_cost(moves(np.zeros((1, 2))), np.array([[x, 0.0, 0.1, 0, 0]]), weights))
        for x in (0.31, 0.2, 0.1, 0.02)
    ]
    assert costs[0] == 0.0
    assert costs[1] == pytest.approx(np.exp(-1) - np.exp(-2), rel=1e-3)
    assert costs[2:] == pytest.approx([1.0 - np.exp(-2)] * 2, rel=1e-3)


def test_the_way_to_the_goal_is_measured_past_what_stands_between() -> None:
    wall = np.array([[0.5, y, 0.08] for y in np.arange(-0.6, 0.31, 0.1)])
    for yaw in (0.0, 2.0):  # whichever way the robot faces, the map is seen from there
        here = state(yaw=yaw)
        field = PotentialField(np.array([1.0, 0.0]), wall, np.zeros(2), FieldSettings())
        seen, weights = field.seen_from(here), Weights(way=1.0)

        def cost(x: float, y: float, seen: DistanceMap = seen, here: State = here, weights: Weights = weights) -> float:
            return value(way_cost(moves(to_heading(np.array([[x, y]]), here)), seen, weights))

        assert cost(1.0, 0.0) < 0.2
        assert cost(1.0, 0.3) < cost(0.5, 0.8) < cost(0.2, 0.0)
        assert cost(0.2, 0.4) < cost(0.2, -0.2)  # nearer to the end of the wall
        assert cost(-3.0, 0.0) > cost(-2.0, 0.0) > cost(-1.0, 0.0)  # beyond the map


def test_goal_cost_wants_to_be_near_and_to_face_the_goal() -> None:
    goal, weights = np.array([1.0, 0.0]), Weights(goal=2.0, facing=3.0)
    assert value(goal_cost(moves(np.zeros((3, 2))), goal, weights)) == pytest.approx(2.0, rel=1e-5)
    away = goal_cost(moves(np.zeros((3, 2)), yaw=np.pi), goal, weights)
    assert value(away) == pytest.approx(2.0 + 3.0 * 2.0, rel=0.01)


def pull(distance: float, weights: Weights, bearing: float = 1.0) -> tuple[float, float]:
    """The cost of a goal in sight, and the size of its gradient on the place."""
    here = moves(np.zeros((1, 2)))
    cost = goal_cost(here, distance * np.array([np.cos(bearing), np.sin(bearing)]), weights)
    (gradient,) = torch.autograd.grad(cost.sum(), here.displacement)
    return value(cost), float(gradient.norm())


def test_each_robot_of_a_batch_may_have_a_goal_of_its_own() -> None:
    goals, weights = np.array([[1.0, 0.0], [0.0, 2.0]]), Weights(goal=2.0, facing=3.0)
    for ticks in (2, 3):  # as many as robots, or more
        one = moves(np.zeros((ticks, 2)))
        two = replace(one, **{name: torch.cat([getattr(one, name)] * 2) for name in ("displacement", "yaw")})
        alone = [value(goal_cost(one, goal, weights)) for goal in goals]
        np.testing.assert_allclose(goal_cost(two, goals, weights).detach().numpy(), alone, rtol=1e-6)


def test_facing_a_near_goal_does_not_outweigh_being_there() -> None:
    facing, goal = Weights(facing=1.0), Weights(goal=1.0)
    for distance in (0.001, 0.02, 0.1):
        assert pull(distance, facing)[1] < 5.0 * pull(distance, goal)[1]
    assert pull(0.02, facing)[1] < 3.0 * pull(0.02, goal)[1]
    # Who faces it is not pushed off, and further away facing is the paper's: 1 - cos, turned by 1 / distance.
    assert pull(0.02, facing, bearing=0.0)[1] == pytest.approx(0.0, abs=1e-3)
    assert pull(1.0, facing) == pytest.approx((1.0 - np.cos(1.0), np.sin(1.0)), rel=0.02)


def test_costs_take_the_times_of_the_states_that_they_are_given() -> None:
    """States are further apart the further ahead they are: the index of one says nothing of its time."""
    even, uneven = np.arange(1, 33), np.array([1, 2, 4, 8, 16, 24, 32])

    def walk(ticks: np.ndarray) -> Trajectory:
        return moves(
            np.stack([0.3 * DT * ticks, 0.02 * np.sin(0.1 * ticks)], axis=-1), velocity=(0.3, 0.0), ticks=ticks
        )

    dense, sparse = walk(even), walk(uneven)
    coming = np.array([[0.5, 0.0, 0.05, -0.2, 0.0]])
    path = np.stack([0.25 * DT * even, np.zeros(32)], axis=-1)
    for asked in (
        Instruction(np.array([0.1, 0.0, 0.3])),
        Instruction(np.zeros(3), goal=np.array([1.0, 0.5])),
        Instruction(np.zeros(3), obstacles=coming),
        Instruction(np.zeros(3), path=path),
    ):
        weights = Weights(goal=1.0, repulsion=1.0, sharpness=3.0)
        assert value(total_cost(sparse, asked, weights)) == pytest.approx(
            value(total_cost(dense, asked, weights)), rel=0.1
        )
    np.testing.assert_allclose(dense.mean(dense.velocity, -2).numpy(), [[0.3, 0.0]])
    np.testing.assert_allclose(sparse.mean(sparse.velocity, -2).numpy(), [[0.3, 0.0]])


def test_a_robot_that_shall_stand_is_guided_to_stand_whatever_the_task_wants() -> None:
    weights = replace(Weights(), velocity=0, yaw_rate=0, displacement=0, yaw=0, stand=0, goal=1.0)
    walking = moves(np.stack([0.1 * np.arange(5), np.zeros(5)], axis=-1), velocity=(0.3, 0.0))
    standing = moves(np.zeros((5, 2)))
    cost = Stopping(partial(total_cost, weights=weights))
    asked = Instruction(np.zeros(3), goal=np.array([1.0, 0.0]))
    assert cost(walking, asked) < cost(standing, asked)
    asked = replace(asked, stand=True)
    assert cost(walking, asked) > cost(standing, asked)
    assert pickle.loads(pickle.dumps(cost))(walking, asked) == cost(walking, asked)


def test_a_waypoint_costs_the_square_of_its_distance() -> None:
    cost = goal_cost(moves(np.zeros((3, 2))), np.array([0.0, 2.0]), Weights(waypoint=0.5))
    assert value(cost) == pytest.approx(2.0, rel=1e-5)


def test_ground_cost_has_a_term_each_for_speed_direction_and_facing() -> None:
    """It is told over the ground: who faces left and walks ahead goes left."""
    left, still = np.array([0.0, 0.3]), np.zeros((5, 2))
    right_way = moves(still, yaw=np.pi / 2, velocity=(0.3, 0.0))
    assert value(ground_cost(right_way, left, Weights(speed=1.0, steering=1.0, heading=1.0))) < 0.02
    slow = moves(still, yaw=np.pi / 2, velocity=(0.1, 0.0))
    assert value(ground_cost(slow, left, Weights(speed=2.0))) == pytest.approx(2.0 * 0.2**2, rel=1e-3)
    aside = moves(still, velocity=(0.0, 0.3))
    assert value(ground_cost(aside, left, Weights(speed=1.0, steering=1.0))) < 0.02
    assert value(ground_cost(aside, left, Weights(heading=2.0))) == pytest.approx(2.0, rel=1e-5)
    ahead = moves(still, velocity=(0.3, 0.0))
    assert value(ground_cost(ahead, left, Weights(steering=2.0))) == pytest.approx(2.0, rel=1e-5)
    standing = np.zeros(2)
    assert value(ground_cost(ahead, standing, Weights(speed=1.0, steering=1.0, heading=1.0))) == pytest.approx(0.09)


def test_at_rest_the_ground_cost_pulls_toward_what_is_asked() -> None:
    rest = moves(np.zeros((5, 2)))
    rest.velocity.requires_grad_()
    cost = ground_cost(rest, np.array([0.2, 0.0]), Weights(speed=1.0, steering=0.05, heading=0.1))
    (gradient,) = torch.autograd.grad(cost.sum(), rest.velocity)
    assert (gradient[..., 0] < 0).all()


def test_path_cost_compares_tick_by_tick_as_far_as_both_go() -> None:
    path = np.stack([0.1 * np.arange(1, 4), np.zeros(3)], axis=-1)
    on_it = moves(np.stack([0.1 * np.arange(1, 7), np.zeros(6)], axis=-1))
    assert value(path_cost(on_it, path, Weights(path=1.0))) == pytest.approx(0.0, abs=1e-12)
    late = moves(np.stack([0.1 * np.arange(0, 6), np.zeros(6)], axis=-1))
    assert value(path_cost(late, path, Weights(path=5.0))) == pytest.approx(5.0 * 0.01)


def test_weights_choose_the_terms_and_zero_leaves_the_planner_to_itself() -> None:
    trajectory = moves(0.1 * np.ones((5, 2)))
    instruction = Instruction(
        velocity=np.array([0.2, 0.0, 0.0]),
        ground=np.array([0.2, 0.2]),
        goal=np.ones(2),
        path=np.ones((5, 2)),
        obstacles=np.ones((2, 5)),
    )
    nothing = Weights(velocity=0, yaw_rate=0, displacement=0, yaw=0, stand=0, path=0, repulsion=0)
    assert value(total_cost(trajectory, instruction, nothing)) == 0.0
    for name in (
        "velocity", "displacement", "speed", "steering", "heading", "goal", "waypoint", "path", "repulsion",
        "avoidance",
    ):  # fmt: skip
        assert value(total_cost(trajectory, instruction, replace(nothing, **{name: 1.0}))) > 1e-6, name
    assert (
        load_settings("survive").cost
        == load_settings("text").cost
        == replace(Weights(), velocity=0, yaw_rate=0, displacement=0, yaw=0, stand=0)
    )
    with pytest.raises(ValueError, match="margin: must be positive"):
        Weights(margin=0.0)


@pytest.mark.parametrize("name", ["goal-near", "goal-far", "goal", "velocity", "path", "forest", "obstacle", "cross"])
def test_a_planner_that_finds_the_way_is_told_no_velocity_and_no_sentence(name: str) -> None:
    task = Drawn(load_task(name, {"way": "cost"}, DT), 1)
    weights = task.settings.weights
    assert not weights.twist
    asked = task.instruct(0, state(), task.percept(state()))
    assert asked.text == ""
    assert asked.velocity.shape == (3,)  # for policies that follow one
    walk = moves(0.1 * np.ones((5, 2)), velocity=(0.2, 0.0))
    assert task.objective is not None
    costs = {value(task.objective(walk, replace(asked, velocity=np.array([v, 0.0, 0.0])))) for v in (0.0, 0.3)}
    assert len(costs) == 1
    assert costs != {0.0}
    scripted = Drawn(load_task(name, {"way": "script"}, DT), 1)
    assert scripted.instruct(0, state(), scripted.percept(state())).text is None


@pytest.mark.parametrize(
    ("task", "settings", "guides"),
    [
        ("survive", {}, False),
        ("text", {}, False),
        ("inbetween", {}, False),
        ("text", {"cost.yaw": "0.1"}, True),
        ("walk", {}, True),
        ("goal", dict.fromkeys(TWIST, "0") | {"cost.goal": "1"}, True),
    ],
)
def test_a_task_whose_cost_is_zero_leaves_a_planner_without_guidance(
    task: str, settings: dict[str, str], guides: bool
) -> None:
    assert (load_task(task, settings).objective is not None) == guides

"""The terms of the guidance cost: what each wants, and where its gradient points."""

from __future__ import annotations

import pickle
from dataclasses import replace

import numpy as np
import pytest
import torch
from task_bodies import DT, Drawn, moves, state

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import DistanceMap, Instruction, State
from servoid.hw.geometry import to_heading
from servoid.hw.robot.description import load_robot
from servoid.policy.features import token_layout
from servoid.policy.trajectory import Slope, Trajectory, by_tokens, sloped
from servoid.stack.navigation.potential_field import FieldSettings, PotentialField
from servoid.stack.tasks import load_settings, load_task
from servoid.stack.tasks.body import build_of
from servoid.stack.tasks.terms.guidance import Stopping, TotalCost
from servoid.stack.tasks.terms.motion import ground_cost
from servoid.stack.tasks.terms.places import goal_cost, obstacle_cost, path_cost, way_cost
from servoid.stack.tasks.terms.weights import Weights

NOTHING = Weights(velocity=0, yaw_rate=0, displacement=0, yaw=0, stand=0, path=0, repulsion=0)
BUILD = build_of(load_robot())
TWIST = tuple(f"cost.{name}" for name in ("velocity", "yaw_rate", "displacement", "yaw", "stand"))


def value(cost: tuple[Array, Slope] | Array) -> float:
    """Of one trajectory, with or without its slope."""
    return (cost[0] if isinstance(cost, tuple) else cost).item()


def test_obstacle_cost_is_the_papers_and_pushes_away() -> None:
    here = moves(np.zeros((4, 2)))
    obstacle = np.array([[0.3, 0.0, 0.05, 0.0, 0.0]])
    cost = obstacle_cost(here, obstacle, Weights(repulsion=2.0, sharpness=10.0))
    assert value(cost) == pytest.approx(2.0 * np.exp(-10.0 * 0.25), rel=1e-4)
    gradient = cost[1]["displacement"]
    assert (gradient[0, :, 0] > 0).all()  # a step down it goes back
    assert (gradient[0, :, 1] == 0).all()
    soft = obstacle_cost(here, obstacle, Weights(repulsion=0.0, avoidance=1.0, margin=0.25))
    assert value(soft) == pytest.approx(np.log(2.0), rel=1e-4)


def test_obstacle_cost_meets_a_moving_obstacle_where_it_will_be() -> None:
    horizon = 25
    still = moves(np.zeros((horizon, 2)))
    coming, leaving = np.array([[0.5, 0, 0.1, -0.4, 0]]), np.array([[0.5, 0, 0.1, 0.4, 0]])
    weights = Weights(repulsion=1.0)
    assert value(obstacle_cost(still, coming, weights)) > 5 * value(obstacle_cost(still, leaving, weights))
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
    assert (
        obstacle_cost(slanting, beside, weights)[1]["yaw"] < 0
    ).all()  # turned further, its side is further from what stands beside it
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


def test_the_way_past_what_stands_between_is_faced() -> None:
    wall = np.array([[0.5, y, 0.08] for y in np.arange(-0.6, 0.31, 0.1)])
    field, here = PotentialField(np.array([1.0, 0.0]), wall, np.zeros(2), FieldSettings()), state(yaw=0.0)
    seen, weights = field.seen_from(here), Weights(along=1.0)
    yaws = np.arange(-3.0, 3.1, 0.25)

    def best(x: float, y: float) -> float:
        costs = [value(way_cost(moves(np.array([[x, y]]), yaw=yaw), seen, weights)) for yaw in yaws]
        return float(yaws[int(np.argmin(costs))])

    assert 0.3 < best(-0.2, 0.2) < 1.6  # the wall's end lies to the left
    assert abs(best(0.5, 0.75)) < 0.6  # past it
    assert -1.6 < best(0.9, 0.5) < -0.5  # behind it, the goal to the right
    reversed_ = value(way_cost(moves(np.array([[-0.2, 0.2]]), yaw=best(-0.2, 0.2) + np.pi), seen, weights))
    assert reversed_ == pytest.approx(2.0, abs=0.1)


def test_goal_cost_wants_to_be_near_and_to_face_the_goal() -> None:
    goal, weights = np.array([1.0, 0.0]), Weights(goal=2.0, facing=3.0)
    assert value(goal_cost(moves(np.zeros((3, 2))), goal, weights)) == pytest.approx(2.0, rel=1e-5)
    away = goal_cost(moves(np.zeros((3, 2)), yaw=np.pi), goal, weights)
    assert value(away) == pytest.approx(2.0 + 3.0 * 2.0, rel=0.01)


def pull(distance: float, weights: Weights, bearing: float = 1.0) -> tuple[float, float]:
    """The cost of a goal in sight, and the size of its gradient on the place."""
    here = moves(np.zeros((1, 2)))
    cost = goal_cost(here, distance * np.array([np.cos(bearing), np.sin(bearing)]), weights)
    return value(cost), float(np.linalg.norm(cost[1]["displacement"]))


def test_each_robot_of_a_batch_may_have_a_goal_of_its_own() -> None:
    goals, weights = np.array([[1.0, 0.0], [0.0, 2.0]]), Weights(goal=2.0, facing=3.0)
    for ticks in (2, 3):  # as many as robots, or more
        one = moves(np.zeros((ticks, 2)))
        two = replace(one, **{name: np.concatenate([getattr(one, name)] * 2) for name in ("displacement", "yaw")})
        alone = [value(goal_cost(one, goal, weights)) for goal in goals]
        np.testing.assert_allclose(goal_cost(two, goals, weights)[0], alone, rtol=1e-6)


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
        assert value(TotalCost(weights)(sparse, asked)) == pytest.approx(
            value(TotalCost(weights)(dense, asked)), rel=0.1
        )
    np.testing.assert_allclose(dense.mean(dense.velocity, -2), [[0.3, 0.0]])
    np.testing.assert_allclose(sparse.mean(sparse.velocity, -2), [[0.3, 0.0]])


def test_a_robot_that_shall_stand_is_guided_to_stand_whatever_the_task_wants() -> None:
    weights = replace(Weights(), velocity=0, yaw_rate=0, displacement=0, yaw=0, stand=0, goal=1.0)
    walking = moves(np.stack([0.1 * np.arange(5), np.zeros(5)], axis=-1), velocity=(0.3, 0.0))
    standing = moves(np.zeros((5, 2)))
    cost = Stopping(TotalCost(weights))
    asked = Instruction(np.zeros(3), goal=np.array([1.0, 0.0]))
    assert cost(walking, asked) < cost(standing, asked)
    asked = replace(asked, stand=True)
    assert cost(walking, asked) > cost(standing, asked)
    assert pickle.loads(pickle.dumps(cost))(walking, asked) == cost(walking, asked)


def test_who_runs_may_slow_down_over_the_first_quarter_of_what_is_planned() -> None:
    """A robot that shall stand at once falls on its face."""
    ticks = np.array([1, 2, 4, 8, 16, 24, 32])
    speeds = np.array([0.4, 0.4, 0.3, 0.1, 0.0, 0.0, 0.0])
    braking = moves(np.zeros((7, 2)), ticks=ticks)
    braking.velocity[..., 0] = speeds
    asked = Instruction(np.zeros(3), stand=True)
    cost = Stopping(TotalCost(NOTHING))
    assert cost(braking, asked) == 0.0
    running = moves(np.zeros((7, 2)), velocity=(0.4, 0.0), ticks=ticks)
    value_, slope = cost.slope(running, asked)
    assert value_.item() == pytest.approx(10.0 * 0.4**2)
    assert (slope["velocity"][0, 4:, 0] > 0.0).all()
    assert not slope["velocity"][0, :4].any()


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
    cost = ground_cost(rest, np.array([0.2, 0.0]), Weights(speed=1.0, steering=0.05, heading=0.1))
    assert (cost[1]["velocity"][..., 0] < 0).all()


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
    assert value(TotalCost(NOTHING)(trajectory, instruction)) == 0.0
    for name in (
        "velocity", "displacement", "speed", "steering", "heading", "goal", "waypoint", "path", "repulsion",
        "avoidance",
    ):  # fmt: skip
        assert value(TotalCost(replace(NOTHING, **{name: 1.0}))(trajectory, instruction)) > 1e-6, name
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


EVERYTHING = Instruction(
    velocity=np.array([0.2, 0.05, 0.3]),
    ground=np.array([0.2, 0.1]),
    goal=np.array([0.5, 0.2]),
    path=0.02 * np.arange(60).reshape(30, 2),
    obstacles=np.array([[0.3, 0.05, 0.05, -0.1, 0.0], [0.1, -0.3, 0.1, 0.0, 0.2]]),
    distances=DistanceMap(np.array([-0.4, -0.3]), 0.4, 0.11, np.random.default_rng(5).uniform(0.5, 1.5, (8, 9))),
    targets={"right hand": np.array([0.2, -0.1, 0.2]), "heading": np.zeros(())},
    bars=np.array([[0.1, 0.0, 1.4, 0.5, 0.3]]),
)


@pytest.mark.parametrize(
    "weights",
    [
        {"velocity": 1.0, "yaw_rate": 0.4, "displacement": 2.0, "yaw": 0.7},
        {"speed": 1.0, "steering": 0.5, "heading": 0.3},
        {"goal": 1.0, "facing": 0.6, "waypoint": 0.4},
        {"way": 1.0},
        {"along": 1.0},
        {"path": 3.0},
        {"repulsion": 1.0, "sharpness": 6.0},
        {"repulsion": 1.0, "sharpness": 6.0, "avoidance": 0.5, "width": 0.17, "depth": 0.06},
        {"repulsion": 1.0, "sharpness": 6.0, "width": 0.17, "depth": 0.06, "safe": 0.4},
        {"reach": 2.0},
        {"bar": 50.0},
    ],
    ids=lambda weights: "-".join(weights),
)
def test_a_slope_is_how_the_cost_changes_with_each_number_of_the_trajectory(weights: dict[str, float]) -> None:
    """Guidance goes by the slope alone: a wrong one would pull a robot aside, and no cost would say so."""
    rng, horizon = np.random.default_rng(1), 6
    walk = Trajectory(
        displacement=rng.uniform(-0.15, 0.25, (2, horizon, 2)),
        yaw=rng.uniform(-1.0, 1.0, (2, horizon)),
        velocity=rng.normal(0.0, 0.2, (2, horizon, 2)),
        yaw_rate=rng.normal(0.0, 0.3, (2, horizon)),
        height=rng.uniform(0.2, 0.3, (2, horizon)),
        gravity=np.array([0.1, -0.05, -0.99]) + rng.normal(0.0, 0.03, (2, horizon, 3)),
        joints=rng.normal(0.0, 0.3, (2, horizon, 20)),
        ticks=np.array([1, 2, 4, 8, 16, 28]),
        dt=DT,
    )
    cost = TotalCost(replace(NOTHING, **weights), BUILD)
    before, slope = cost.slope(walk, EVERYTHING)
    assert (before > 1e-3).all()
    # Nobody shall lean over to reach, nor be somewhere else to face the way from there.
    spared = {"gravity"} if "reach" in weights else {"displacement"} if "along" in weights else set()
    for name in set(Trajectory.FIELDS) - spared:
        values = getattr(walk, name)
        for index in rng.integers(0, values.shape, (25, values.ndim)):
            nudged = values.copy()
            nudged[tuple(index)] += 1e-5
            change = (cost(replace(walk, **{name: nudged}), EVERYTHING) - before) / 1e-5
            told = slope.get(name, np.zeros_like(values))[tuple(index)]
            assert change[index[0]] == pytest.approx(told, abs=2e-4 * (1.0 + abs(told))), (name, index)
            assert change[1 - index[0]] == 0.0  # trajectories of a batch are apart


def test_a_cost_written_with_torch_has_the_slope_that_torch_finds() -> None:
    def cost(trajectory: Trajectory, instruction: Instruction) -> torch.Tensor:
        return trajectory.mean((trajectory.displacement**2).sum(-1)) + trajectory.yaw.cos().sum(-1)

    walk = moves(0.1 * np.arange(8).reshape(4, 2), yaw=0.5)
    value_, slope = sloped(cost).slope(walk, Instruction(np.zeros(3)))
    assert value_.shape == (1,)
    np.testing.assert_allclose(slope["displacement"], 2.0 * walk.displacement / 4)
    np.testing.assert_allclose(slope["yaw"], -np.sin(0.5))
    assert "joints" not in slope
    assert sloped(Stopping(cost)) is not None


def test_the_gradient_on_tokens_is_that_of_the_cost_of_tokens() -> None:
    """From a trajectory back to what the network predicts: headings are a cosine and a sine there."""
    rng = np.random.default_rng(2)
    tokens = rng.normal(0.0, 0.4, (1, 3, token_layout(20).size))
    cost = TotalCost(replace(NOTHING, goal=1.0, facing=0.5, velocity=1.0, yaw_rate=0.2, yaw=0.3, reach=1.0), BUILD)

    def of(tokens: Array) -> tuple[Array, Slope]:
        return cost.slope(Trajectory.of(tokens, 20, DT), EVERYTHING)

    before, slope = of(tokens)
    gradient = by_tokens(slope, tokens, 20)
    leaning = range(*token_layout(20).slice("gravity").indices(100))
    for feature in set(range(tokens.shape[-1])) - set(leaning):
        nudged = tokens.copy()
        nudged[0, 1, feature] += 1e-6
        assert (of(nudged)[0] - before).item() / 1e-6 == pytest.approx(gradient[0, 1, feature], abs=1e-4), feature

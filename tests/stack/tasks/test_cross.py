"""Robots that cross: which way they choose, what they are told, and how a finished run is judged."""

from __future__ import annotations

import math
from dataclasses import replace
from typing import Any

import numpy as np
import pytest
from task_bodies import Drawn, moves, state

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.task import Trace
from servoid.hw.contracts.world import Percept
from servoid.stack.navigation.collision_avoidance import AvoidanceSettings, MeanVelocity, bearing_past
from servoid.stack.tasks import load_settings, load_task

DT = 0.02
GOAL = np.array([2.0, 0.0])


def cross(seed: int = 0, **settings: str) -> Any:
    return Drawn(load_task("cross", settings, DT), seed)


def bearing(*others: tuple[float, float, float, float]) -> float:
    return bearing_past(GOAL, np.array(others).reshape(-1, 4), 0.25, 0.0, AvoidanceSettings())


# --- the way past others


def test_nobody_in_the_way_is_nobody_to_avoid() -> None:
    assert bearing() == 0.0
    assert bearing((1.0, 1.0, 0.0, 0.0)) == 0.0
    assert bearing((-0.3, 0.0, 0.0, 0.0)) == 0.0  # behind
    assert bearing((0.8, 0.5, 0.0, 0.25)) == 0.0  # it will have gone


def test_who_comes_head_on_is_passed_on_the_right() -> None:
    assert -1.2 < bearing((1.0, 0.0, -0.25, 0.0)) < -0.1
    assert -1.2 < bearing((1.0, 0.0, 0.0, 0.0)) < -0.1  # as is who stands there
    assert bearing((1.0, -0.35, 0.0, 0.0)) > 0.0  # but who stands far on the right, on the left


def test_a_way_once_chosen_is_kept() -> None:
    other = np.array([[1.0, -0.05, 0.0, 0.0]])
    settings = replace(AvoidanceSettings(), right=0.0, steady=1.0)
    ways = [bearing_past(GOAL, other, 0.25, before, settings) for before in (-0.5, 0.5)]
    assert ways[0] < 0.0 < ways[1]


def test_velocity_is_the_mean_over_the_window() -> None:
    motion = MeanVelocity(window=0.2, dt=DT)
    assert not motion.update(np.zeros((2, 2))).any()
    for tick in range(1, 40):
        sway = 0.02 * math.sin(2.0 * math.pi * tick / 10)  # as fast as the window is long
        velocity = motion.update(np.array([[0.1 * DT * tick, sway], [1.0, -0.2 * DT * tick]]))
    np.testing.assert_allclose(velocity, [[0.1, 0.0], [0.0, -0.2]], atol=1e-9)


# --- an episode with bodies that obey


def walk(first: Any, seconds: float) -> Trace:
    """Bodies that at once do what they are told, and see each other."""
    asked = [first.behaviour, *first.behaviour.teammates]
    scene = first.scene
    poses = np.vstack([np.zeros(3), scene.robots[:, :3]])
    goals = np.vstack([scene.goal, scene.robots[:, 3:]])
    rows = []
    for tick in range(round(seconds / DT)):
        rows.append(poses.copy())
        moved = poses.copy()
        for i, behaviour in enumerate(asked):
            percept = Percept("test", 0.0, goal=goals[i], robots=np.delete(poses, i, 0))
            forward, left, turn = behaviour.instruct(tick, state(*poses[i]), percept).velocity
            cos, sin = np.cos(poses[i, 2]), np.sin(poses[i, 2])
            moved[i] += DT * np.array([cos * forward - sin * left, sin * forward + cos * left, turn])
        if first.done(state(*poses[0])):
            break
        poses = moved
    return trace(np.array(rows))


def trace(poses: Array, fallen: bool = False, touched: bool | None = None) -> Trace:
    """A trace of robots at `poses` `(ticks, n, 3)`."""
    ticks = len(poses)
    return Trace(
        dt=DT,
        displacement=np.pad(poses[:, 0, :2], ((0, 0), (0, 1))),
        yaw=poses[:, 0, 2],
        velocity=np.zeros((ticks, 3)),
        yaw_rate=np.zeros(ticks),
        command=np.zeros((ticks, 3)),
        fallen=fallen,
        robots=poses[:, 1:],
        touched=touched,
    )


@pytest.mark.parametrize("robots", [2, 3, 4])
@pytest.mark.parametrize("seed", range(3))
def test_all_that_obey_get_across_and_keep_apart(robots: int, seed: int) -> None:
    task = cross(seed, robots=str(robots))
    gone = walk(task, 40.0)
    assert task.success(gone)
    assert task.metrics(gone)["arrived"] == robots
    assert task.metrics(gone)["apart_m"] > 0.3  # what two of them need beside each other


def test_without_a_thought_for_the_others_they_meet() -> None:
    task = cross(robots="2", spread="0", **{"passing.apart": "0.001"})
    gone = walk(task, 40.0)
    assert not task.success(gone)
    assert task.metrics(gone)["touched"] == 1.0


def test_the_others_are_told_as_obstacles_where_they_will_be() -> None:
    task = cross()
    for tick in range(60):
        seen = np.array([[1.0, 0.5 - 0.2 * DT * tick, 0.0], [2.0, -1.0, 0.0]])
        told = task.instruct(tick, state(0.0, 0.0, math.pi / 2), Percept("scene", 0.0, robots=seen))
    np.testing.assert_allclose(told.obstacles[0], [seen[0, 1], -1.0, 0.15, -0.2, 0.0], atol=1e-9)
    np.testing.assert_allclose(told.obstacles[1, 3:], 0.0, atol=1e-9)
    np.testing.assert_allclose(told.goal, [0.0, -2.2], atol=1e-9)


def test_the_cost_keeps_a_distance_from_where_the_others_will_be() -> None:
    task = cross()
    ahead = moves(np.stack([0.005 * np.arange(1, 25), np.zeros(24)], axis=-1))
    free, met = (
        replace(
            task.instruct(0, state(), Percept("scene", 0.0)),
            velocity=np.array([0.25, 0.0, 0.0]),
            obstacles=np.array([[0.4, 0.3, 0.15, 0.0, speed]]),
        )
        for speed in (0.5, -0.5)
    )
    assert task.objective(ahead, met) > task.objective(ahead, free)


def test_who_has_arrived_stands_and_the_first_is_done_when_all_have() -> None:
    task = cross(robots="2")
    there, other = state(2.2, 0.0, 0.0), task.behaviour.teammates[0]
    alone = Percept("scene", 0.0, robots=np.array([[1.0, 0.0, math.pi]]))
    assert not task.instruct(0, there, alone).velocity.any()
    assert not task.done(there)
    other.instruct(0, there, alone)
    assert task.done(there)
    assert not other.done(there)  # it stands until the first one's run ends
    other.arrived = False
    other.lost()
    assert task.done(there)


def test_success_needs_all_there_none_fallen_and_none_touched() -> None:
    task = cross()
    scene = task.scene
    ends = np.column_stack([np.vstack([scene.goal, scene.robots[:, 3:]]), np.zeros(3)])
    starts = np.vstack([np.zeros(3), scene.robots[:, :3]])
    poses = np.stack([starts, ends])
    assert task.success(trace(poses))
    assert not task.success(trace(poses, fallen=True))
    assert not task.success(trace(poses, touched=True))
    poses[-1, 2, 0] += 0.2
    assert not task.success(trace(poses, touched=False))
    assert task.metrics(trace(poses))["arrived"] == 2.0
    assert not task.success(trace(np.zeros((0, 3, 3))))


# --- settings


def test_starts_lie_on_the_circle_and_goals_opposite() -> None:
    for seed in range(5):
        scene = cross(seed, robots="4").scene
        assert scene.robots.shape == (3, 5)
        middle = np.array([1.1, 0.0])
        np.testing.assert_allclose(np.linalg.norm(scene.robots[:, :2] - middle, axis=1), 1.1)
        np.testing.assert_allclose(scene.robots[:, :2] + scene.robots[:, 3:], np.tile(2.0 * middle, (3, 1)), atol=1e-9)
        facing = np.stack([np.cos(scene.robots[:, 2]), np.sin(scene.robots[:, 2])], axis=-1)
        np.testing.assert_allclose(scene.robots[:, :2] + 1.1 * facing, np.tile(middle, (3, 1)), atol=1e-9)


@pytest.mark.parametrize(
    ("settings", "words"),
    [
        ({"robots": "1"}, "robots: must be 2 to 4, not 1"),
        ({"robots": "5"}, "robots: must be 2 to 4, not 5"),
        ({"circle": "0.3"}, "circle: 0.3 m is too small a radius for 3 robots, 0.7 m apart: give 0.47 or more"),
        ({"spread": "1.1"}, "spread: 1.1 rad: give 0 to less than 1.047"),
        ({"passing.fade": "0"}, "fade: must be positive"),
    ],
)
def test_what_cannot_be_crossed_is_refused(settings: dict[str, str], words: str) -> None:
    with pytest.raises(ConfigError, match=words) as refused:
        load_settings("cross", settings)
    assert len(str(refused.value).splitlines()) == 1

"""Tasks that policies learn, as tasks that are run: what is asked, and the return by a trace."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from task_bodies import state

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.task import Trace
from servoid.hw.contracts.world import Percept
from servoid.hw.robot.description import load_robot
from servoid.policy.priors.goals import GOALS
from servoid.stack.tasks.learned.run import Draws, LearnedSettings, RunDodgeball, RunLocation, RunSpeed, SpeedSettings

ROBOT, DT = load_robot(), 0.02
PERCEPT = Percept(source="task", age=0.0)


def trace(places: Array) -> Trace:
    """Of a robot that was at `places` `(ticks, 2)` m and faced ahead."""
    n = len(places)
    still = np.zeros((n, 3))
    return Trace(DT, np.c_[places, np.full(n, 0.3)], np.zeros(n), still, np.zeros(n), still, fallen=False)


def straight(speed: float, seconds: float) -> Array:
    t = np.arange(round(seconds / DT)) * DT
    return np.stack([speed * t, 0.0 * t], -1)


def test_the_return_is_the_mean_reward_of_the_whole_episode() -> None:
    task = RunSpeed(SpeedSettings(seconds=10.0, steady=0.3), DT, ROBOT)
    episode = task.scenario(np.random.default_rng(0))
    at_speed = task.rewards(trace(straight(0.3, 10.0)), episode)
    assert at_speed[-1] == pytest.approx(1.0)
    assert at_speed[0] < 0.5  # until a cycle is over, it has hardly moved
    assert task.metrics(trace(straight(0.3, 10.0)), episode)["return"] > 0.95
    half = task.metrics(trace(straight(0.3, 5.0)), episode)["return"]  # a fall ended it
    assert half == pytest.approx(at_speed[:250].sum() / 500)
    assert not task.success(replace(trace(straight(0.3, 10.0)), fallen=True), episode)
    assert task.metrics(trace(straight(0.0, 10.0)), episode)["return"] < 0.1
    assert task.metrics(trace(np.zeros((0, 2))), episode)["return"] == 0.0


def test_a_place_lies_around_where_the_robot_then_is_and_is_judged_there() -> None:
    task = RunLocation(LearnedSettings(seconds=20.0), DT, ROBOT)
    episode = Draws(seeds=task.scenario(np.random.default_rng(1)).seeds[:2], ticks=np.array([0, 400]))
    first = task.drawn(episode, 0, np.zeros(2))
    second = task.drawn(episode, 1, first)
    places = np.where(np.arange(1000)[:, None] < episode.ticks[1], first, second)
    places[0], places[episode.ticks[1]] = 0.0, first  # where it is as it is asked
    rewards = task.rewards(trace(places), episode)
    expected = np.ones(1000)
    expected[[0, episode.ticks[1]]] = rewards[[0, episode.ticks[1]]]
    assert np.allclose(rewards, expected)
    assert rewards[0] < 1.0


def test_the_robot_is_told_what_it_is_judged_by() -> None:
    task = RunLocation(LearnedSettings(seconds=20.0), DT, ROBOT)
    episode = task.scenario(np.random.default_rng(1))
    asks = task.behaviour(episode)
    told = asks.instruct(0, state(), PERCEPT)
    assert told.goal is not None
    assert np.allclose(told.goal, task.drawn(episode, 0, np.zeros(2)))
    assert GOALS["location"].observe(told, ROBOT.walking).shape == (4,)
    bearing = np.arctan2(told.goal[1], told.goal[0])
    assert told.velocity[2] * bearing > 0.0  # a walker that knows no places is led there
    again = asks.instruct(1, state(), PERCEPT)
    assert again.goal is not None
    assert np.allclose(again.goal, told.goal)


def test_a_ball_that_hits_ends_what_is_earned() -> None:
    task = RunDodgeball(LearnedSettings(seconds=20.0), DT, ROBOT)
    episode = task.scenario(np.random.default_rng(2))
    rewards = task.rewards(trace(np.zeros((1000, 2))), episode)
    hit = int(np.flatnonzero(rewards == 0.0)[0])
    assert 50 < hit < 400  # thrown at it from 1 to 2 m, at 0.3 to 0.6 m/s
    assert not rewards[hit:].any()
    thrown = task.behaviour(episode)
    far, near = (thrown.instruct(tick, state(), PERCEPT).obstacles for tick in (0, hit))
    assert far is not None
    assert near is not None
    assert np.hypot(*near[0, :2]) < 0.3 < np.hypot(*far[0, :2])
    assert not task.success(trace(np.zeros((1000, 2))), episode)
    assert task.metrics(trace(np.zeros((1000, 2))), episode)["hit"] == 1.0
    away = trace(np.full((hit - 1, 2), 50.0) * np.arange(hit - 1)[:, None] / hit)  # far from any
    assert task.success(away, episode)
    assert not task.success(replace(away, fallen=True), episode)


def test_what_is_told_of_a_ball_is_what_was_seen_of_it() -> None:
    """Its velocity is known once it was seen twice, and with the error of where it was first seen."""
    task = RunDodgeball(LearnedSettings(seconds=20.0), DT, ROBOT)
    thrown = task.behaviour(replace(task.scenario(np.random.default_rng(2)), ticks=np.array([0])))
    seen = [thrown.instruct(tick, state(), PERCEPT).obstacles for tick in range(60)]
    assert all(balls is not None for balls in seen)
    balls = np.array(seen)[:, 0]
    assert not balls[:5, 3:].any()
    truth = (balls[59, :2] - balls[0, :2]) / (59 * DT)
    errors = np.linalg.norm(balls[6:, 3:] - truth, axis=1)
    assert 0.0 < errors[-1] < errors[0] < 0.5
    assert errors[-1] < 0.05


def test_draws_are_the_same_for_every_policy() -> None:
    task = RunSpeed(SpeedSettings(), DT, ROBOT)
    a, b = (task.scenario(np.random.default_rng(3)) for _ in range(2))
    assert np.array_equal(a.seeds, b.seeds)
    assert Draws(seeds=a.seeds, ticks=np.array([0, 10])).number(9) == 0
    assert Draws(seeds=a.seeds, ticks=np.array([0, 10])).number(10) == 1

"""Tasks with a scene, run through the whole stack."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import load_robot
from servoid.sim.backend import SimBackend
from servoid.stack.log.flightlog import read_log
from servoid.stack.runtime.run import RunSettings, prepare, run
from servoid.tools.commands import replay
from servoid.tools.common.ground_truth import GroundTruth
from servoid.tools.common.pictures import flightpath
from servoid.tools.evaluate.judge import judge, simulation


@pytest.mark.slow
def test_who_walks_into_a_pillar_fails_by_the_truth() -> None:
    """The robot is told of another pillar: its own velocity leads it into the one that stands there."""
    forest = {"places": "0.3,0,0.05", "x": "1", "field.body": "0.001", "field.strength": "0.001"}
    job = RunSettings("forest", policy="gait", seconds=8.0, set=forest)
    row = judge(job).row
    assert not row["success"]
    assert row["metrics"]["touched"] == 1.0 or row["fell"]


@pytest.mark.slow
def test_a_goal_behind_a_pillar_is_reached_around_it(tmp_path: Path) -> None:
    settings = RunSettings(
        "forest",
        policy="gait",
        seconds=30.0,
        set={"places": "0.4,0,0.05", "x": "0.8"},
        record=tmp_path / "forest.mcap",
    )
    task, body = prepare(settings)
    ground_truth = GroundTruth(simulation(body), 0.02)
    result = run(settings, backend=body, on_tick=ground_truth)
    truth = ground_truth.trace()
    assert result.outcome == "succeeded"
    assert task.success(truth)
    assert truth.touched is False
    assert truth.obstacles is not None
    np.testing.assert_allclose(truth.obstacles[0, 0], [0.4, 0.0, 0.05], atol=0.03)  # seen from where the task began
    log = read_log(tmp_path / "forest.mcap")
    seen = flightpath.obstacles(log)
    assert seen is not None
    assert seen.shape == (result.ticks, 1, 3)
    assert log.messages["/instruction"][0]["source"] == "scene"
    assert log.header["scene"]["pillars"] == [[0.4, 0.0, 0.05]]
    assert replay.replay(log)[1] is None


TURNED = np.array([np.cos(0.1), 0.0, 0.0, np.sin(0.1)])  # quaternion of a base at a yaw of 0.2


@pytest.mark.parametrize("name", ["goal-far", "forest"])
def test_the_goal_is_judged_where_it_is_seen_wherever_the_task_began(name: str) -> None:
    """A robot that turned while it stood up sees the goal where the scene has it."""
    task, body = prepare(RunSettings(name, seconds=10.0, seed=1))
    seen = simulation(body)
    truth: Any = seen.truth
    ground_truth = GroundTruth(seen, 0.02)
    record: Any = SimpleNamespace(proposal=SimpleNamespace(instruction=SimpleNamespace(velocity=np.zeros(3))))
    assert seen.surroundings is not None
    goal = seen.surroundings.scene.goal
    truth.qpos[0, :2], truth.qpos[0, 3:7] = (0.03, -0.02), TURNED
    ground_truth(record)
    truth.qpos[0, :2] = goal
    ground_truth(record)
    trace = ground_truth.trace()
    assert task.success(trace)
    np.testing.assert_allclose(trace.displacement[-1, :2], trace.goal[-1], atol=1e-12)
    assert np.linalg.norm(trace.goal[-1] - goal) > 0.1 * np.linalg.norm(goal)
    truth.qpos[0, :2] = trace.goal[-1]  # where it would lie if the robot had not turned
    ground_truth(record)
    assert not task.success(ground_truth.trace())


def test_goals_of_several_robots_are_judged_where_they_are_seen() -> None:
    task, body = prepare(RunSettings("cross", seconds=10.0, seed=1))
    seen = simulation(body)
    truth: Any = seen.truth
    ground_truth = GroundTruth(seen, 0.02)
    record: Any = SimpleNamespace(proposal=SimpleNamespace(instruction=SimpleNamespace(velocity=np.zeros(3))))
    assert seen.surroundings is not None
    scene = seen.surroundings.scene
    truth.qpos[0, 3:7] = TURNED
    ground_truth(record)
    truth.qpos[:, :2] = np.vstack([scene.goal, scene.robots[:, 3:]])
    ground_truth(record)
    trace = ground_truth.trace()
    assert task.metrics(trace)["arrived"] == 3.0
    estimate = replace(trace, displacement=np.array([[2.2 * np.cos(0.2), -2.2 * np.sin(0.2), 0.0]]))
    assert ground_truth.odometry_error(estimate) == pytest.approx(0.0, abs=1e-6)  # in the frame of its odometry


def test_a_backend_without_the_scene_is_refused() -> None:
    with pytest.raises(ConfigError, match="task 'obstacle' has a scene: make the backend with it"):
        run(RunSettings("obstacle", policy="gait"), backend=SimBackend(load_robot()))


@pytest.mark.slow
@pytest.mark.parametrize(
    "name", ["goal-near", "goal-far", "velocity", "path", "perturb", "survive", "text", "obstacle"]
)
def test_every_task_runs_with_the_gait(name: str) -> None:
    row = judge(RunSettings(name, policy="gait", seconds=3.0, seed=1)).row
    assert row["outcome"] in ("timed_out", "succeeded", "failed")
    assert not row["fell"]
    assert row["metrics"]


@pytest.mark.slow
def test_a_rig_shows_the_same_scene_as_the_simulation() -> None:
    """Same robot, same sphere: on virtual within the quantisation and delay of the bus."""
    traces = []
    for backend in ("sim", "virtual"):
        job = RunSettings("obstacle", policy="gait", backend=backend, seconds=2.0, set={"bearing": "3.1"})
        _, body = prepare(job)
        ground_truth = GroundTruth(simulation(body), 0.02)
        run(job, backend=body, on_tick=ground_truth)
        traces.append(ground_truth.trace())
    sim, virtual = traces
    assert sim.obstacles is not None
    assert virtual.obstacles is not None
    assert virtual.touched is False
    np.testing.assert_allclose(virtual.obstacles[-1], sim.obstacles[-1], atol=0.03)
    rolled = np.linalg.norm(virtual.obstacles[-1, 0, :2] - virtual.obstacles[0, 0, :2])
    assert rolled == pytest.approx(0.08 * 2.0, rel=0.1)

"""Tasks with a scene, run through the whole stack."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hw.config import ConfigError
from hw.robot import load_robot
from sim.backend import SimBackend
from stack.flightlog import read_log
from stack.session import Settings, prepare, run
from tools import flightpath, replay
from tools.rollout import episode
from tools.witness import Witness


def test_who_walks_into_a_pillar_fails_by_the_truth() -> None:
    """The robot is told of another pillar: its own velocity leads it into the one that stands there."""
    job = Settings("forest", policy="gait", seconds=8.0, set={"places": "0.3,0,0.05", "x": "1", "field.body": "0.001",
                                                              "field.strength": "0.001"})  # fmt: skip
    row = episode(job)
    assert not row["success"]
    assert row["metrics"]["touched"] == 1.0 or row["fell"]


def test_a_goal_behind_a_pillar_is_reached_around_it(tmp_path: Path) -> None:
    settings = Settings(
        "forest",
        policy="gait",
        seconds=30.0,
        set={"places": "0.4,0,0.05", "x": "0.8"},
        record=tmp_path / "forest.mcap",
    )
    task, body = prepare(settings)
    witness = Witness(body.truth, 0.02, body.stage)  # type: ignore[attr-defined]
    result = run(settings, backend=body, on_tick=witness)
    truth = witness.trace()
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


def test_a_backend_without_the_scene_is_refused() -> None:
    with pytest.raises(ConfigError, match="task 'obstacle' has a scene: make the backend with it"):
        run(Settings("obstacle", policy="gait"), backend=SimBackend(load_robot()))


@pytest.mark.parametrize(
    "name", ["goal-near", "goal-far", "velocity", "path", "perturb", "survive", "text", "obstacle"]
)
def test_every_task_runs_with_the_gait(name: str) -> None:
    row = episode(Settings(name, policy="gait", seconds=3.0, seed=1))
    assert row["outcome"] in ("timed_out", "succeeded", "failed")
    assert not row["fell"]
    assert row["metrics"]


def test_a_rig_shows_the_same_scene_as_the_simulation() -> None:
    """Same robot, same sphere: on virtual within the quantisation and delay of the bus."""
    traces = []
    for backend in ("sim", "virtual"):
        job = Settings("obstacle", policy="gait", backend=backend, seconds=2.0, set={"bearing": "3.1"})
        _, body = prepare(job)
        witness = Witness(body.truth, 0.02, body.stage)  # type: ignore[attr-defined]
        run(job, backend=body, on_tick=witness)
        traces.append(witness.trace())
    sim, virtual = traces
    assert sim.obstacles is not None
    assert virtual.obstacles is not None
    assert virtual.touched is False
    np.testing.assert_allclose(virtual.obstacles[-1], sim.obstacles[-1], atol=0.03)
    rolled = np.linalg.norm(virtual.obstacles[-1, 0, :2] - virtual.obstacles[0, 0, :2])
    assert rolled == pytest.approx(0.08 * 2.0, rel=0.1)

"""Getting up as a task: bodies begin lying, on both simulated backends, and the run gets them up first."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servoid.hw.robot.description import load_robot
from servoid.sim.rig.servo.plant import Plant
from servoid.stack.runtime.run import RunSettings, run
from servoid.stack.tasks import load_task
from servoid.tools.evaluate.judge import judge
from servoid.tools.evaluate.metrics import rose_in_time

ROBOT = load_robot()


@pytest.mark.slow
@pytest.mark.parametrize(("lying", "backend"), [("front", "sim"), ("rolling", "sim"), ("back", "virtual")])
def test_it_gets_up_from_how_it_lies(lying: str, backend: str) -> None:
    judged = judge(RunSettings("get-up", backend=backend, policy="gait", recover=True, seed=2, set={"lying": lying}))
    assert judged.trace.displacement[0, 2] < 0.5 * ROBOT.standing_height
    assert judged.row["success"]
    assert judged.row["falls"] == 1
    assert rose_in_time(judged.row)
    assert 1.0 < judged.row["metrics"]["seconds_until_up"] < 9.0
    assert not judged.assignment.success(replace(judged.trace, fallen=True))


def test_without_recover_a_robot_that_lies_ends_where_it_is() -> None:
    result = run(RunSettings("get-up", policy="gait", set={"lying": "front"}))
    assert result.outcome == "fell"
    assert result.ticks == 0


def test_lying_is_drawn_on_all_sides_and_on_the_ground() -> None:
    task = load_task("get-up", {"lying": "anyhow"}, ROBOT.dt, ROBOT)
    starts = [task.scenario(np.random.default_rng(seed)).start for seed in range(24)]
    plant, facing = Plant(ROBOT), []
    for start in starts:
        assert start is not None
        plant.laid = start
        plant.place(start.joints[0])
        gravity = plant.truth.gravity[0]
        assert abs(gravity[2]) < 0.2, "it lies"
        facing.append(gravity[0])
        plant.release()
        assert 0.03 < plant.truth.position[0, 2] < 0.3
    assert min(facing) < -0.7
    assert max(facing) > 0.7
    plant.reset(0)
    assert plant.truth.gravity[0, 2] < -0.99, "a reset puts it on its feet again"


def test_an_episode_that_did_not_rise_did_not_rise_in_time() -> None:
    assert rose_in_time({"stand_seconds": [4.2], "fell": False})
    assert not rose_in_time({"stand_seconds": [5.2], "fell": False})
    assert not rose_in_time({"stand_seconds": [4.2], "fell": True})
    assert not rose_in_time({"stand_seconds": [], "fell": False})

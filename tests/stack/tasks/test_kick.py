"""The kick: a ball at either foot, its speed and way by the truth, and errors where there is none."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fake_body import FakeBody, StillEstimator, observation

from servoid.hw.config import ConfigError
from servoid.hw.contracts.world import Percept
from servoid.hw.robot.description import load_robot
from servoid.stack.runtime.run import RunSettings, run
from servoid.stack.tasks import load_task
from servoid.tools.evaluate.judge import judge

ROBOT = load_robot()


@pytest.mark.slow
@pytest.mark.parametrize(("foot", "backend"), [("left", "sim"), ("right", "sim"), ("left", "virtual")])
def test_either_foot_kicks_the_ball_ahead(foot: str, backend: str) -> None:
    judged = judge(RunSettings("kick", backend=backend, policy="gait", set={"foot": foot}))
    figures = judged.row["metrics"]
    assert judged.row["success"], judged.assignment.criteria(judged.trace)
    assert 2.0 < figures["ball_speed_mps"] < 3.0
    assert abs(figures["ball_angle_rad"]) < 0.3
    assert figures["ball_distance_m"] > 1.0
    still = replace(judged.trace, objects=np.repeat(judged.trace.objects[:1], len(judged.trace.objects), 0))
    assert not judged.assignment.success(still), "the robot kicked, and missed"
    assert not judged.assignment.success(replace(judged.trace, fallen=True))


def test_where_no_ball_is_seen_the_run_does_not_begin() -> None:
    with pytest.raises(ConfigError, match="task 'kick' needs to see its ball, and backend 'fake' shows none"):
        run(RunSettings("kick", policy="gait", start=True), backend=FakeBody(ROBOT))


@pytest.mark.parametrize(
    ("chosen", "message"),
    [
        ({"ahead": "0.5"}, "ahead: must be 0.09 to 0.17, not 0.5"),
        ({"diameter": "0"}, "diameter: must be positive"),
        ({"foot": "both"}, "one of left, right, any"),
    ],
)
def test_a_ball_that_cannot_be_is_refused(chosen: dict[str, str], message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        load_task("kick", chosen)


@pytest.mark.parametrize(
    ("objects", "message"),
    [
        (None, "there is no ball to kick"),
        (np.array([[0.6, 0.05, 0.035, 1, 0, 0, 0]]), "the ball is 0.60 m ahead and 0.05 m to the left: the foot does"),
        (np.array([[0.12, -0.05, 0.035, 1, 0, 0, 0]]), "0.12 m ahead and -0.05 m to the left"),
    ],
)
def test_it_does_not_kick_at_what_is_not_there(objects: np.ndarray | None, message: str) -> None:
    """A ball that rolled away meanwhile: the kick would shake the robot for nothing."""
    task = load_task("kick", {"foot": "left"}, ROBOT.dt, ROBOT)
    behaviour = task.behaviour(task.scenario(np.random.default_rng(0)))
    state = StillEstimator(ROBOT).update(observation(ROBOT, 0, ROBOT.home), ROBOT.home)
    with pytest.raises(ConfigError, match=message):
        behaviour.instruct(25, state, Percept("scene", 0.0, objects=objects))

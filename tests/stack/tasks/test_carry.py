"""Carrying: the box that is drawn, how a run is judged, and a robot that does it."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from task_bodies import state

from servoid.hw.config import ConfigError
from servoid.hw.contracts.world import Percept
from servoid.hw.robot.description import load_robot
from servoid.policy.priors.goals import GOALS
from servoid.stack.control.carrier import facing
from servoid.stack.runtime.run import RunSettings
from servoid.stack.tasks import load_task
from servoid.stack.tasks.learned.carry import STANDS, Carry, seen_box
from servoid.tools.evaluate.judge import judge

ROBOT = load_robot()


@pytest.mark.slow
def test_a_script_picks_the_box_up_from_the_ground_and_brings_it() -> None:
    judged = judge(RunSettings("carry", policy="carrier", seed=2968811710))
    figures = judged.row["metrics"]
    assert judged.row["success"], judged.assignment.criteria(judged.trace)
    assert figures["return"] > 0.5
    boxes = judged.trace.objects
    assert boxes is not None
    assert boxes[0, 0, 2] == pytest.approx(STANDS, abs=0.005)  # it stood on the ground
    left = boxes.copy()
    left[:, 0] = boxes[0, 0]
    assert not judged.assignment.success(replace(judged.trace, objects=left)), "it stayed where it was"
    assert not judged.assignment.success(replace(judged.trace, fallen=True))


@pytest.mark.slow
def test_what_learned_from_the_script_picks_it_up_too() -> None:
    figures = judge(RunSettings("carry", policy="carry", seed=2968811710, seconds=12.0)).row["metrics"]
    assert figures["held"] == 1.0
    assert figures["return"] > 0.3


def test_the_box_is_drawn_ahead_and_is_seen_as_it_stands_there() -> None:
    task = Carry(ROBOT)
    box = task.place(np.random.default_rng(0))
    distance = float(np.linalg.norm(box[0, :2]))
    assert 0.3 <= distance <= 0.6
    seen = seen_box(box[0], state())
    assert seen == pytest.approx(box[0])
    goal = np.array([0.9, 0.2])
    told = replace(task.instruct(goal, state()), box=seen)
    numbers = GOALS["box"].observe(told, ROBOT.walking)
    assert numbers.shape == (15,)
    assert numbers[:2] @ (box[0, :2] / distance) > 0.0  # it is led to the box first,
    held = replace(told, box=np.r_[0.16, 0.0, 0.2, 1.0, 0.0, 0.0, 0.0])
    assert GOALS["box"].observe(held, ROBOT.walking)[:2] @ goal > 0.0  # and then to its place
    mirrored = replace(told, box=seen * [1, -1, 1, 1, -1, 1, -1], goal=told.goal * [1, -1])
    assert GOALS["box"].observe(mirrored, ROBOT.walking) == pytest.approx(GOALS["box"].mirror(numbers))


def test_either_side_across_which_it_fits_between_the_arms_will_do() -> None:
    turned = np.array([0.3, 0.0, STANDS, np.cos(1.45), 0.0, 0.0, np.sin(1.45)])  # by 2.9 rad
    assert facing(turned) == pytest.approx(2.9 - np.pi)


def test_a_run_without_a_box_is_refused() -> None:
    task = load_task("carry")
    behaviour = task.behaviour(task.scenario(np.random.default_rng(0)))
    with pytest.raises(ConfigError, match="there is no box to carry"):
        behaviour.instruct(0, state(), Percept(source="task", age=0.0))
    with pytest.raises(ConfigError, match="the task gives none: run carry"):
        GOALS["box"].observe(replace(Carry(ROBOT).instruct(np.zeros(2), state()), goal=None), ROBOT.walking)

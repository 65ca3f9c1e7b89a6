"""A task policy at the end of a run: asked to stand, it comes to rest in the home pose."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest
from task_bodies import state

from servoid.hw.contracts.control import Instruction
from servoid.hw.robot.description import load_robot
from servoid.policy.mlp import Mlp
from servoid.policy.priors.goals import GOALS
from servoid.policy.priors.observation import TaskObservation
from servoid.policy.priors.task_policy import FADING, SLOWING, TaskPolicy, save_task_policy

ROBOT = load_robot()


def policy(folder: Path, goal: str) -> TaskPolicy:
    """One that always leaves home."""
    size, n = TaskObservation(ROBOT, GOALS[goal]).size, len(ROBOT.joints)
    network = Mlp([(np.zeros((size, n), np.float32), np.ones(n, np.float32))], np.zeros(size), np.ones(size))
    config = {"hidden": [], "task": goal, "goal": goal, "stride": 2, "reach": [0.1] * n}
    about = {"data": "made", "licence": "Apache-2.0", "results": {}, "training": {}}
    save_task_policy(folder / "policy.safetensors", network, ROBOT, config, about)
    return TaskPolicy(ROBOT, folder / "policy.safetensors")


STAND = Instruction(np.zeros(3), stand=True)
HALT = Instruction(np.zeros(3), goal=np.array([0.5, 0.0]))
WALK = Instruction(np.array([0.2, 0.0, 0.0]), goal=np.array([0.5, 0.0]))


@pytest.mark.parametrize(
    ("goal", "asked", "rests"),
    [("velocity", STAND, True), ("steering", HALT, True), ("velocity", WALK, False), ("location", STAND, True),
     ("location", HALT, False)],
)  # fmt: skip
def test_it_comes_to_rest_at_home_where_it_is_to_stand(
    tmp_path: Path, goal: str, asked: Instruction, rests: bool
) -> None:
    made, home = policy(tmp_path, goal), ROBOT.home
    made.reset(None, np.zeros((), int))
    ticks = round((SLOWING + FADING) / ROBOT.dt) + 1
    away = [np.abs(made.act(state(), home, asked) - home).max() for _ in range(ticks)]
    assert away[0] == pytest.approx(0.1)
    assert away[-1] == pytest.approx(0.0 if rests else 0.1, abs=1e-9)
    assert np.abs(np.diff(away)).max() < 0.1 * 1.01 * ROBOT.dt / FADING  # it fades, and does not jump
    assert np.abs(made.act(state(), home, WALK) - home).max() == pytest.approx(0.1)  # and it goes on

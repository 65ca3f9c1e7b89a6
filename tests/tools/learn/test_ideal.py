"""The bound on returns: who has no limits earns all that a cycle's mean lets it, and every limit costs something."""

from __future__ import annotations

from dataclasses import replace

import pytest

from servoid.hw.robot.description import load_robot
from servoid.stack.tasks.learned import load_learned_task
from servoid.tools.learn.envs.ideal import TASKS, Ideal, ideal_return

ROBOT = load_robot()


@pytest.mark.parametrize("name", TASKS)
def test_every_limit_costs_something(name: str) -> None:
    task, n, seconds = load_learned_task(name, ROBOT), 48, 6.0
    swift = replace(ROBOT, walking=replace(ROBOT.walking, forward=9.0, backward=9.0, sideways=9.0, turning=60.0))
    at_once, quick, slow, late = (
        ideal_return(*given)
        for given in (
            (load_learned_task(name, swift), Ideal(), n, seconds),
            (task, Ideal(), n, seconds),
            (task, Ideal((0.5, 2.0)), n, seconds),
            (task, Ideal((0.5, 2.0), 0.24), n, seconds),
        )
    )
    assert 0.0 < late <= slow <= quick < 1.0
    assert late < quick
    if name == "location":  # whose places do not go further away for who is faster
        assert quick < at_once
        assert at_once > 0.9

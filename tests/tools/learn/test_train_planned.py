"""A fleet that is planned for as one batch is asked for the same as a robot by itself."""

from __future__ import annotations

from dataclasses import replace
from types import SimpleNamespace
from typing import Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction
from servoid.hw.robot.description import load_robot
from servoid.policy.diffusion.features import raw_layout
from servoid.policy.diffusion.model.action_space import JOINT_TARGETS
from servoid.policy.diffusion.settings import DiffusionSettings
from servoid.stack.control.fleet import Fleet
from servoid.tools.learn.envs.planned import PlannedWalker

ROBOT = load_robot()


class Spy:
    """Stands in for the runtime: holds the home pose, and remembers what it was asked."""

    settings = DiffusionSettings(trim=5.0)
    model = SimpleNamespace(config=SimpleNamespace(history=4, action_size=20), space=JOINT_TARGETS)
    actions = 16

    def __init__(self) -> None:
        self.asked: Instruction

    def plan_batch(
        self, states: Array, actions: Array, instruction: Instruction, seeds: Any, previous: Any
    ) -> tuple[Array, Array]:
        self.asked = instruction
        return np.tile(ROBOT.home, (len(states), 16, 1)), np.zeros((len(states), 16, raw_layout(20).size))


def test_what_is_asked_is_corrected_and_has_the_name_of_its_correction() -> None:
    spy, fleet = Spy(), Fleet(ROBOT, 2, None, threads=1)
    walker, everything = PlannedWalker(fleet, spy), np.ones(2, bool)  # type: ignore[arg-type]
    fleet.reset(everything)
    walker.reset(everything)
    turning = replace(fleet.observe(), angular_velocity=np.tile([0.0, 0.0, 0.4], (2, 1)))
    command = np.array([[0.1, 0.0, 0.0], [0.2, 0.0, 0.0]])
    for _ in range(200):
        fleet.state = turning
        walker.act(command)
    assert (spy.asked.velocity[:, 2] < -0.2).all()
    assert spy.asked.text is None

"""Ways to guide a planner, beside each other."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from servoid.hw.contracts.control import Instruction, PlanRequest
from servoid.hw.robot.description import load_robot
from servoid.policy.diffusion.plan_quality import denoising_error, plan_cost
from servoid.policy.diffusion.runtime import load_runtime
from servoid.policy.diffusion.settings import load_settings
from servoid.policy.features import raw_layout
from servoid.stack.tasks import load_task
from servoid.tools import cli


@pytest.mark.slow
def test_a_row_tells_what_guidance_changed_and_what_came_of_it(capfd: pytest.CaptureFixture[str]) -> None:
    options = "--episodes 2 --seconds 0.5 --variant settings --variant states --json"
    assert cli.main(["bench", "guidance", *options.split()]) == 0
    scaled, states = json.loads(capfd.readouterr().out)["rows"]
    for row in (scaled, states):
        assert (row["arrived"], row["fallen"], row["seconds"]) == (0, 0, None)
        assert row["cost_after"] < row["cost_before"]
        assert row["lowered"] > 0.9
    assert scaled["error_before"] == pytest.approx(states["error_before"], rel=0.2)
    assert scaled["error_after"] < 0.5 * states["error_after"], "states that are moved alone are like no motion"


@pytest.mark.slow
def test_a_plan_of_another_motion_than_the_model_knows_is_far_from_its_data() -> None:
    robot = load_robot()
    settings = load_settings("lookahead")
    runtime = load_runtime(robot, replace(settings, guidance=replace(settings.guidance, weight=0.0)))
    layout, history = raw_layout(len(robot.joints)), runtime.model.config.history
    row = np.zeros(layout.size, np.float32)
    row[layout.slice("displacement")] = 0.0, 0.0, robot.standing_height
    row[layout.slice("gravity")] = 0.0, 0.0, -1.0
    row[layout.slice("position")] = robot.home
    states, actions = np.tile(row, (1, history, 1)), np.tile(robot.home, (1, history - 1 + settings.delay, 1))
    asked = Instruction(np.zeros(3), goal=np.array([[1.0, 0.0]]), text="")
    request = PlanRequest(0, states, actions, asked, seeds=np.zeros(1, int))
    plan = runtime.plan(request)
    bent = plan.states.copy()
    bent[..., layout.slice("position")] += 0.3 * np.sin(np.arange(bent.shape[1]))[:, None]
    assert denoising_error(runtime, request, replace(plan, states=bent)) > 3.0 * denoising_error(runtime, request, plan)
    cost = load_task("goal-far", {"way": "cost"}, robot.dt).objective
    nearer = plan.states.copy()
    nearer[..., layout.slice("displacement")][..., 0] += 0.2
    before, after = (
        plan_cost(runtime, request, replace(plan, states=x), cost, robot.dt) for x in (plan.states, nearer)
    )
    assert after == pytest.approx(before - 0.2 * 0.6, abs=0.03)

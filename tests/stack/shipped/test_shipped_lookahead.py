"""The planner that ships and looks two seconds ahead: by a cost alone it goes somewhere, and stops."""

from __future__ import annotations

import pytest

from servoid.policy.checkpoint import read_header, resolve
from servoid.policy.diffusion.settings import load_settings
from servoid.stack.runtime.run import RunSettings
from servoid.tools.evaluate.judge import judge

pytestmark = pytest.mark.slow


def test_a_goal_ahead_is_reached_by_its_distance_and_bearing_alone_and_stood_at() -> None:
    asked = {"way": "cost", "x": "0.6", "y": "0.2"}
    row = judge(RunSettings("goal-far", policy="lookahead", seed=3, seconds=12.0, set=asked)).row
    assert row["success"]
    assert not row["fell"]
    assert not row["fell_ending"]  # while it came to rest, with a goal that is still there


def test_the_planner_looks_two_seconds_ahead_and_plans_actions_for_what_runs() -> None:
    settings = load_settings("lookahead")
    config = read_header(resolve(settings.checkpoint))["config"]
    assert config["ticks"][-1] == config["horizon"] == 96
    assert settings.execution_horizon + settings.delay <= config["actions"]

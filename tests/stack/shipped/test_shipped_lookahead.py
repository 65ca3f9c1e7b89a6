"""The planner that ships and looks two seconds ahead: by a cost alone it goes somewhere, and stops."""

from __future__ import annotations

import numpy as np
import pytest

from servoid.policy.checkpoint import read_header, resolve
from servoid.policy.diffusion.settings import load_settings
from servoid.stack.runtime.run import RunSettings, run

pytestmark = pytest.mark.slow


def test_a_goal_ahead_is_reached_by_its_distance_and_bearing_alone_and_stood_at() -> None:
    asked = {"way": "cost", "x": "0.6", "y": "0.2"}
    result = run(RunSettings("goal-far", policy="lookahead", seed=3, seconds=12.0, set=asked))
    assert result.success, result.outcome
    assert not result.trace.fallen  # nor while it came to rest, with a goal that is still there
    assert np.linalg.norm(result.trace.velocity[-1, :2]) < 0.1


def test_the_planner_looks_two_seconds_ahead_and_plans_actions_for_what_runs() -> None:
    settings = load_settings("lookahead")
    config = read_header(resolve(settings.checkpoint))["config"]
    assert config["ticks"][-1] == config["horizon"] == 96
    assert settings.execution_horizon + settings.delay <= config["actions"]

"""The checkpoint that ships, in closed loop, by the truth."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from shipped_runs import drive, walked

from servoid.hw.config import CONFIGS
from servoid.hw.robot.description import load_robot
from servoid.sim.backend import SimBackend
from servoid.stack.runtime.run import RunSettings, run

pytestmark = pytest.mark.slow

ROBOT = load_robot()


@pytest.mark.parametrize(
    ("asked", "least"),
    [({"vx": "0.2"}, (1.3, 0.0, 0.0)), ({"vy": "-0.08"}, (0.0, -0.3, 0.0)), ({"yaw_rate": "0.6"}, (0.0, 0.0, 3.0))],
)
def test_it_starts_from_rest_and_walks_ten_seconds_where_it_is_asked(
    asked: dict[str, str], least: tuple[float, float, float], tmp_path: Path
) -> None:
    body = SimBackend(ROBOT, seed=4)
    turned, heading = 0.0, 0.0

    def follow(_: object) -> None:
        nonlocal turned, heading
        now = float(body.truth.yaw[0])
        turned += (now - heading + np.pi) % (2 * np.pi) - np.pi
        heading = now

    result = run(RunSettings("walk", seed=4, seconds=10.0, set=asked), backend=body, on_tick=follow)
    assert result.outcome == "succeeded"
    went = np.array([*result.trace.displacement[-1][:2], turned])
    for reached, wanted in zip(went, least, strict=True):
        assert reached * np.sign(wanted) >= abs(wanted)


@pytest.mark.parametrize(("name", "schedule", "samples"), [("uniphys", "pyramid", 3), ("diffuse_cloc", "rolling", 1)])
def test_it_walks_by_the_settings_of_either_paper(name: str, schedule: str, samples: int) -> None:
    driven = walked(drive("walk", {"vx": "0.2"}, policy=str(CONFIGS / "policies" / f"{name}.yaml")))
    assert driven.truth.displacement[-1, 0] > 0.2
    assert abs(driven.truth.displacement[-1, 1]) < 0.2
    runtime = driven.planner.runtime
    assert (runtime.settings.schedule, runtime.samples) == (schedule, samples)
    assert runtime.cost is not None
    # With the rolling schedule a plan goes on from the one that runs: told of another, it would be another.
    last = driven.planner.requests[-1]
    first = driven.plans[0].plan
    others = driven.planner.answer(last).actions, driven.planner.answer(replace(last, previous=first)).actions
    assert np.array_equal(*others) == (schedule != "rolling")

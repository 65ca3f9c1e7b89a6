"""The checkpoint that ships, in closed loop, by the truth."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from hw.robot import load_robot
from sim.backend import SimBackend
from stack.session import Settings, run

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

    result = run(Settings("walk", seed=4, seconds=10.0, set=asked), backend=body, on_tick=follow)
    assert result.outcome == "succeeded"
    went = np.array([*result.trace.displacement[-1][:2], turned])
    for reached, wanted in zip(went, least, strict=True):
        assert reached * np.sign(wanted) >= abs(wanted)

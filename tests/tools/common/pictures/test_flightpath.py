"""Plans of a log, put where the robot was when it asked for them."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from servoid.stack.log.flightlog import FlightLog
from servoid.stack.log.format import SCHEMAS, pack
from servoid.tools.common.pictures import flightpath


def test_a_plan_starts_where_it_was_requested_and_points_along_the_heading():
    messages = {channel: [] for channel in SCHEMAS}
    for tick in range(10):
        place = pack([0.1 * tick, 0.0, 0.25], "<f4")
        messages["/state"].append({"tick": tick, "displacement": place, "yaw": pack(np.pi / 2, "<f4")})
        if tick >= 4:  # the task begins at tick 4 of the run
            messages["/instruction"].append({"tick": tick, "place": pack([1.0, 2.0], "<f4")})
    path = pack([[0.0, 0.0], [0.5, 0.0]], "<f4")  # half a metre ahead
    messages["/plan"] = [
        {"tick": 8, "requested": 2, "adopted": 4, "path": path},
        {"tick": 12, "requested": 6, "adopted": 8, "path": path},  # after the task, to come to rest
    ]
    log = FlightLog(Path("a.mcap"), {}, messages, complete=True)
    (plan,) = flightpath.plans(log)
    assert plan.adopted == 8
    np.testing.assert_allclose(plan.path, [[0.6, 0.0], [0.6, 0.5]], atol=1e-6)
    np.testing.assert_allclose(flightpath.goal(log), [1.0, 2.0])

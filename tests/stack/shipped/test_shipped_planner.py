"""The planner that ships, in its loop: what it is told it does, and it stays on its feet."""

from __future__ import annotations

import pytest

from servoid.policy.checkpoint import read_header, resolve
from servoid.policy.text.captions import MOTIONS
from servoid.stack.control.closed_loop import load_settings
from servoid.stack.runtime.run import RunSettings
from servoid.tools.evaluate.judge import judge


@pytest.mark.slow
def test_a_point_aside_is_reached_by_plans_that_a_tracker_follows() -> None:
    judged = judge(RunSettings("reach", policy="closd", seed=4, set={"by": "words"}))
    assert judged.row["success"]
    assert not judged.row["fell"]
    assert judged.row["metrics"]["acts_share"] == 1.0


def test_it_is_told_all_that_walking_is_called() -> None:
    told = read_header(resolve(load_settings().checkpoint))["sentences"]
    assert {motion.phrasings[0] for motion in MOTIONS} <= set(told)

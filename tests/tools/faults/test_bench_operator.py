"""Stops and losses at the page, one of each: the bench that counts them sees what happens."""

from __future__ import annotations

import io
import random

import pytest

from servoid.tools.cli import main
from servoid.tools.common.output import Report
from servoid.tools.faults.operator import WAYS, Losses, stops, summarise_stops
from servoid.tools.web.launch import View, open_page

pytestmark = pytest.mark.slow


def test_a_stop_at_the_page_lowers_a_walk_and_turns_torque_off() -> None:
    (row,) = stops(Report(False, io.StringIO()), 1, seed=3)
    assert row["outcome"] == "interrupted"
    assert row["all_off"]
    assert row["rest_ticks"] <= 2
    assert row["lowering_s"] <= 2.0  # the rig's own time, which no wall keeps
    assert summarise_stops([row])["lowered"] == 1


def test_whoever_steers_is_lost_again_and_again_and_each_time_the_robot_rests() -> None:
    with open_page(View(port=0), "op3") as page:
        found = Losses(page, WAYS[0], 2, random.Random(1)).measure()
    assert len(found) == 2
    assert min(found) > 0.0


def test_numbers_that_cannot_be_are_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "operator", "--stops", "-1"]) == 2
    assert "--stops -1 --losses 20: must not be negative" in capsys.readouterr().err

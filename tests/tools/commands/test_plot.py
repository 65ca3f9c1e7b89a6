"""Plots say whose run they show."""

from __future__ import annotations

from pathlib import Path

from servoid.hw.robot.description import load_robot
from servoid.stack.control.gait import GaitPolicy
from servoid.stack.log.flightlog import read_log
from servoid.stack.runtime.run import RunSettings, run
from servoid.tools.commands.plot import title


class Marcher(GaitPolicy):
    """A policy of a program's own."""


def test_a_programs_own_policy_is_not_taken_for_the_default(tmp_path: Path) -> None:
    log = tmp_path / "mine.mcap"
    run(RunSettings("walk", seconds=0.1, seed=3, record=log), policy=Marcher(load_robot()))
    assert title(read_log(log)).startswith("walk with Marcher on op3, seed 3: ")

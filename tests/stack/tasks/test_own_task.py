"""A task of a user's own, in a file: what goes wrong in it while the robot walks, and a cost of its own."""

from __future__ import annotations

from pathlib import Path

import pytest

from servoid.hw.contracts.body import Mode
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.run import RunSettings, run

BREAKS = """
import numpy as np
from servoid.hw.contracts.control import Instruction
from servoid.stack.tasks import BaseBehaviour
from servoid.stack.tasks.stand import Stand


class Breaks(Stand):
    name = description = "breaks"

    def behaviour(self, episode):
        return Breaking(episode)


class Breaking(BaseBehaviour):
    def instruct(self, tick, state, percept):
        if tick == 20:
            raise KeyError("sofa")
        return Instruction(velocity=np.zeros(3))
"""

GUIDED = """
from dataclasses import dataclass
from servoid.stack.tasks.stand import Stand


@dataclass
class Cost:
    factor: float

    def __call__(self, trajectory, instruction):
        return self.factor * (trajectory.velocity**2).sum(-1).mean(-1)


class Guided(Stand):
    name = description = "guided"
    objective = Cost(2.0)
"""


def test_a_task_that_fails_ends_the_run_safely_and_says_where(tmp_path: Path) -> None:
    """A mistake in somebody's first task must not drop a robot."""
    file, records = tmp_path / "breaks.py", list[TickRecord]()
    file.write_text(BREAKS)
    result = run(RunSettings(f"{file}:Breaks", policy="gait", seconds=5.0), on_tick=records.append)
    assert result.outcome == "stopped"
    assert result.ticks == 20
    line = BREAKS.splitlines().index('            raise KeyError("sofa")') + 1
    assert f"the task failed: KeyError: 'sofa' ({file}:{line})" in [event.text for event in result.events]
    modes = [record.command.mode for record in records[-100:]]
    assert modes[-1] is Mode.OFF
    assert Mode.ACTIVE in modes, "it was lowered first"


@pytest.mark.slow
def test_a_planner_in_a_process_of_its_own_is_guided_by_a_cost_of_the_file(tmp_path: Path) -> None:
    file = tmp_path / "guided.py"
    file.write_text(GUIDED)
    result = run(RunSettings(f"{file}:Guided", seconds=1.0, realtime=True))
    assert [event.text for event in result.events if "failed" in event.text] == []
    assert result.outcome == "succeeded"

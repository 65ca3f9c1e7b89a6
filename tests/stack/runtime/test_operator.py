"""The person in control: the dead man's switch, wishes to stop, goals and sentences, and runs that repeat them."""

from __future__ import annotations

import math
from collections.abc import Callable
from pathlib import Path

import numpy as np
import pytest

from servoid.hw.contracts.operator import Halt, Intent
from servoid.stack.log.flightlog import read_log
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.operator import HEARD, LOST, LOST_SECONDS, REST_SECONDS, SILENT, STOP, Operator
from servoid.stack.runtime.run import RunSettings, run
from servoid.stack.safety.phase import Phase
from servoid.tools.commands import replay

FORWARD = np.array([1.0, 0.0, 0.0])
BEGIN = 150  # a tick at which the task has begun


class Person:
    """Wants at each tick what `wants` says."""

    def __init__(self, wants: Callable[[int], Intent]) -> None:
        self._wants, self._tick = wants, -1

    def read(self) -> Intent:
        self._tick += 1
        return self._wants(self._tick)

    def close(self) -> None:
        pass


def watched(task: str, wants: Callable[[int], Intent], record: Path | None = None, **more: object):
    """A run under a person who has to be heard, and its ticks."""
    ticks: list[TickRecord] = []
    settings = RunSettings(task, policy="gait", record=record, seconds=more.pop("seconds", 8.0), **more)  # type: ignore[arg-type]
    return run(settings, on_tick=ticks.append, operator=Operator(Person(wants))), ticks


def at(ticks: list[TickRecord], phase: Phase) -> int:
    return next(record.tick for record in ticks if record.phase is phase)


def test_a_robot_rests_when_nobody_is_heard_and_goes_on_when_somebody_is(tmp_path: Path) -> None:
    """A walk that a terminal started would go on with nobody there, and come to rest for nobody in particular."""

    def wants(tick: int) -> Intent:
        return Intent(age=max(0.0, (tick - BEGIN) * 0.02) if tick < BEGIN + 50 else 0.0)

    log = tmp_path / "run.mcap"
    result, ticks = watched("walk", wants, log, seconds=4.0, set={"vx": "0.2"})
    asked = {record.tick: record.proposal.instruction for record in ticks if record.proposal.instruction is not None}
    last = BEGIN + round(REST_SECONDS / 0.02)
    assert asked[last].velocity[0] == 0.2
    assert not asked[last + 1].velocity.any()
    assert not asked[BEGIN + 49].velocity.any()
    assert asked[BEGIN + 50].velocity[0] == 0.2
    assert [event.text for event in result.events if event.kind == "operator"] == [SILENT, HEARD]
    assert replay.replay(read_log(log))[1] is None


def test_a_robot_whose_person_stays_away_is_lowered() -> None:
    result, ticks = watched("walk", lambda tick: Intent(age=max(0.0, (tick - BEGIN) * 0.02)))
    assert at(ticks, Phase.STOPPING) == BEGIN + round(LOST_SECONDS / 0.02) + 1
    assert result.outcome == "stopped"
    assert LOST in [event.text for event in result.events]
    assert ticks[-1].phase is Phase.DAMPED


def test_until_the_first_word_a_robot_stands() -> None:
    """A page that nobody has opened yet is no reason to lower the robot, nor to move it."""
    result, ticks = watched("walk", lambda tick: Intent(age=math.inf), seconds=3.0)
    asked = [record.proposal.instruction for record in ticks if record.proposal.instruction is not None]
    assert len(asked) > 3.0 * 50
    assert not any(instruction.velocity.any() for instruction in asked)
    assert result.outcome != "stopped"


@pytest.mark.parametrize(("halt", "phase"), [(Halt.ORDERLY, Phase.STOPPING), (Halt.AT_ONCE, Phase.DAMPED)])
def test_a_wish_to_stop_is_heeded_at_its_tick_in_any_task(halt: Halt, phase: Phase, tmp_path: Path) -> None:
    log = tmp_path / "run.mcap"
    result, ticks = watched("walk", lambda tick: Intent(halt=halt if tick >= BEGIN + 30 else Halt.NO), log)
    assert at(ticks, phase) == BEGIN + 30
    assert result.outcome == "interrupted"
    assert result.interrupted
    if halt is Halt.ORDERLY:
        assert STOP in [event.text for event in result.events]
        assert Phase.LOWERING in {record.phase for record in ticks}
    assert replay.replay(read_log(log))[1] is None


def test_a_person_steers_by_sticks_a_goal_and_a_sentence(tmp_path: Path) -> None:
    def wants(tick: int) -> Intent:
        if tick < BEGIN + 60:
            return Intent(1, way=FORWARD)
        if tick < BEGIN + 120:
            return Intent(2, goal=np.array([0.0, 3.0]))
        return Intent(3, text="turn left", ends=tick > BEGIN + 180)

    log = tmp_path / "run.mcap"
    result, ticks = watched("steer", wants, log)
    asked = {record.tick: record.proposal.instruction for record in ticks if record.proposal.instruction is not None}
    assert asked[BEGIN].velocity[0] == 0.25
    assert asked[BEGIN + 100].goal is not None
    assert asked[BEGIN + 100].velocity[2] > 0.0  # the goal is to the left
    assert asked[BEGIN + 150].text == "turn left"
    assert asked[BEGIN + 150].velocity[2] > 0.0
    assert result.outcome == "succeeded"
    assert result.ticks == BEGIN + 182 - at(ticks, Phase.RUNNING) - 1
    assert replay.replay(read_log(log))[1] is None


def test_a_sentence_that_means_nothing_moves_nothing() -> None:
    """It comes from a stranger's keyboard, and must not end the run either."""
    result, ticks = watched("steer", lambda tick: Intent(text="qwertz uiop"), seconds=1.0)
    asked = [record.proposal.instruction for record in ticks if record.proposal.instruction is not None]
    assert not any(instruction.velocity.any() for instruction in asked)
    assert result.outcome == "succeeded"


@pytest.mark.slow
def test_a_skill_is_performed_each_time_that_it_is_asked_for_and_an_unknown_one_never(tmp_path: Path) -> None:
    def wants(tick: int) -> Intent:
        if tick < BEGIN:
            return Intent()
        if tick < BEGIN + 50:
            return Intent(skill="rm -rf", skills=1)  # a page may say anything
        return Intent(skill="nod", skills=2) if tick < BEGIN + 275 else Intent(skill="nod", skills=3)

    log = tmp_path / "run.mcap"
    result, _ = watched("steer", wants, log, seconds=12.0)
    told = [event.text for event in result.events if event.kind == "skill"]
    assert told == ["'nod' begins", "'nod' is over"] * 2, result.events
    assert result.outcome == "timed_out" or result.success
    assert replay.replay(read_log(log))[1] is None


def test_a_sentence_may_ask_for_a_skill_and_walking_leaves_it() -> None:
    said = {0: Intent(text="nod"), 50: Intent(text="walk forward"), 100: Intent(way=FORWARD)}

    def wants(tick: int) -> Intent:
        return said[max((at for at in said if at <= tick - BEGIN), default=0)]

    _, ticks = watched("steer", wants, seconds=6.0)
    asked = {record.tick - BEGIN: record.proposal.instruction for record in ticks if record.proposal.instruction}
    assert asked[20].skill == "nod"
    assert asked[60].skill is None
    assert asked[60].velocity[0] > 0.05
    assert asked[110].velocity[0] == 0.25

"""A summary says what failed, by how much and when, by one clock and without repeating itself."""

from __future__ import annotations

import io
from pathlib import Path
from typing import Any

import pytest

from servoid.hw.contracts.task import Criterion
from servoid.hw.robot.description import load_robot
from servoid.stack.runtime.run import Result, RunSettings, run
from servoid.stack.safety.event import Event
from servoid.stack.tasks import beyond, load_settings, load_task, names
from servoid.stack.tasks.base import BaseTask
from servoid.tools.common.live import LiveLine
from servoid.tools.common.summary import OUTCOMES, fold, summary, told


@pytest.fixture(scope="module")
def pushed() -> tuple[Result, str]:
    """A run that fell over a push, and what was shown while it went on."""
    stream = io.StringIO()
    live = LiveLine(stream)
    result = run(RunSettings("walk", policy="gait", seconds=4.0, set={"push": "3"}), on_tick=live)
    return result, stream.getvalue()


def late(tick: int) -> Event:
    text = f"the plan requested at tick {tick} was not ready at {tick + 1}: that of {tick - 2} goes on"
    return Event(tick + 90, tick * 0.02 + 1.8, "plan", None, text)


def test_what_comes_again_and_again_is_one_line() -> None:
    heat = [Event(1, 0.02, "temperature", name, f"{name} is at 71 C: let it cool") for name in ("l_knee", "r_knee")]
    folded = fold([*(late(tick) for tick in range(4, 100, 4)), *heat])
    assert [(what.first.kind, what.count) for what in folded] == [("plan", 24), ("temperature", 1), ("temperature", 1)]
    assert folded[0].first == late(4)
    assert folded[0].last == late(96).time


def test_a_planners_ticks_are_told_as_times() -> None:
    assert (
        told(late(100), 0.02) == "planner: the plan requested at 2.00 s was not ready at 2.02 s: that of 1.96 s goes on"
    )


def test_every_time_is_by_the_tasks_clock(pushed: tuple[Result, str]) -> None:
    """The guard's clock, which began with the run, once stood beside it."""
    result, shown = pushed
    assert result.outcome == "fell"
    (fall,) = [line for line in summary(result) if "fall: tilted" in line]
    assert float(fall.split()[0]) == pytest.approx(result.seconds, abs=0.041)
    assert f"the robot fell after {result.seconds:.2f} s (times count from the start of the task)" in summary(result)
    assert "   0.0 s  asked" in shown  # so does the line while it runs


def test_lines_fit_a_narrow_terminal(pushed: tuple[Result, str]) -> None:
    assert max(len(line) for line in summary(pushed[0], 80)) < 80


def test_a_run_that_fails_says_what_it_lacked_and_by_how_much() -> None:
    result = run(RunSettings("goal", policy="gait", seconds=1.0, set={"x": "1.0"}))
    text = "\n".join(summary(result))
    lacks = result.metrics["final_distance_m"] - 0.1
    assert "goal not met in time" in text
    assert f"not met: final distance from the goal {lacks + 0.1:.3g} m, at most 0.1 m: {lacks:.3g} m too much" in text
    (unmet,) = [values for values in result.summary()["criteria"] if values["unit"] == "m"]
    assert not unmet["met"]
    assert unmet["value"] - unmet["most"] == pytest.approx(lacks)


@pytest.mark.parametrize("name", names())
def test_success_is_judged_by_what_is_told(name: str) -> None:
    """A task with a success of its own could fail without a criterion that was not met."""
    task = load_task(name, {})
    assert isinstance(task, BaseTask)
    assert type(task).success is BaseTask.success


@pytest.mark.parametrize(
    ("criterion", "words", "met"),
    [
        (Criterion("error", 8.866, "m/s", most=0.1), "error 8.87 m/s, at most 0.1 m/s: 8.77 m/s too much", False),
        (Criterion("error", 0.05, "m/s", most=0.1), "error 0.05 m/s, at most 0.1 m/s", True),
        (Criterion("arrived", 2, "robots", least=3), "arrived 2 robots, at least 3 robots: 1 robots too little", False),
        (Criterion("error", float("nan"), "m/s", most=0.1), "error not measured, at most 0.1 m/s", False),
        (Criterion.never("fell", True), "fell", False),
        (Criterion.never("fell", False), "never fell", True),
    ],
)
def test_a_criterion_in_words(criterion: Criterion, words: str, met: bool) -> None:
    assert str(criterion) == words
    assert criterion.met is met


@pytest.mark.parametrize(
    ("task", "chosen", "expected"),
    [
        ("walk", {"vx": "9"}, ["vx=9 is more than op3 can: 0.5 m/s at most that way"]),
        ("walk", {"vx": "-0.4", "vy": "0.1"}, ["vx=-0.4 is more than op3 can: 0.15 m/s at most that way"]),
        ("goal", {"approach.speed": "0.7"}, ["approach.speed=0.7 is more than op3 can: 0.5 m/s at most that way"]),
        ("steer", {"turning": "3"}, ["turning=3 is more than op3 can: 1 rad/s at most that way"]),
        *((name, {}, []) for name in names()),
    ],
)
def test_a_speed_that_the_robot_cannot_reach_is_named(task: str, chosen: dict[str, Any], expected: list[str]) -> None:
    assert beyond(load_settings(task, chosen), load_robot()) == expected


def test_there_are_words_for_each_outcome() -> None:
    page = (Path(__file__).resolve().parents[3] / "docs" / "files.md").read_text()
    assert all(f"`{outcome}`" in page for outcome in OUTCOMES)

"""The loop's end of the line to the page: it never waits, and the page's death changes nothing."""

from __future__ import annotations

import math
from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from page_line import Line

from servoid.hw.contracts.operator import Halt
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.run import RunSettings, prepare, run
from servoid.stack.safety.event import Event
from servoid.tools.web.line.panel import Panel, Paragraph
from servoid.tools.web.line.snapshot import RunInfo

INFO = RunInfo("op3", "walk", "sim", "gait", simulated=True)


@pytest.fixture(scope="module")
def ticks() -> list[TickRecord]:
    """Of a short walk."""
    made: list[TickRecord] = []
    run(RunSettings("walk", policy="gait", seconds=1.0), on_tick=made.append)
    return made


@pytest.fixture
def line() -> Iterator[Line]:
    made = Line()
    yield made
    made.link.close()
    made.page.close()


def test_a_page_that_takes_nothing_loses_ticks_but_no_event(line: Line, ticks: list[TickRecord]) -> None:
    line.link.begin(INFO)
    for number in range(4000):  # more than fits any line
        event = Event(number, 0.0, "test", None, f"event {number}")
        line.link(replace(ticks[60], tick=number, events=(event,) if number % 50 == 0 else ()))
    early = line.told()
    assert early[0] == ("run", INFO)
    line.link(ticks[61])
    arrived = [value for kind, value in [*early, *line.told()] if kind == "tick"]
    assert len(arrived) < 4000
    told = [event.text for snapshot in arrived for event in snapshot.events if event.kind == "test"]  # type: ignore[attr-defined]
    assert told == [f"event {number}" for number in range(0, 4000, 50)]


def test_a_page_that_dies_changes_nothing(line: Line, ticks: list[TickRecord]) -> None:
    line.ask("beat", way=(1.0, 0.0, 0.0))
    assert line.link.read().way[0] == 1.0
    line.page.close()
    for record in ticks:
        line.link(record)
        line.link.read()
    assert not line.link.alive
    line.link.end("failed", "text")
    line.now = 10**9
    assert line.link.read().age == 1.0  # and nobody is heard any more


def test_nobody_was_heard_before_the_first_word(line: Line) -> None:
    assert line.link.read().age == math.inf
    line.ask("stop")  # anyone may: it does not show that somebody is in control
    assert line.link.read().age == math.inf
    line.ask("beat", way=(0.0, 0.0, 0.0))
    line.now = 5
    assert line.link.read().age == 0.0


def test_of_sticks_goal_and_sentence_the_last_counts(line: Line) -> None:
    line.ask("goal", place=(1.0, 2.0))
    line.ask("beat", way=(0.0, 0.0, 0.0))  # sticks that nobody touches leave the goal standing
    goal = line.link.read().goal
    assert goal is not None
    assert goal.tolist() == [1.0, 2.0]
    line.ask("text", text="turn left")
    wish = line.link.read()
    assert (wish.goal, wish.text) == (None, "turn left")
    line.ask("beat", way=(0.0, 0.0, 0.5))
    wish = line.link.read()
    assert (wish.text, wish.way.tolist()) == (None, [0.0, 0.0, 0.5])
    line.ask("goal", place=(1.0, 2.0))
    line.ask("rest")
    wish = line.link.read()
    assert (wish.goal, wish.way.any()) == (None, False)
    line.ask("end")
    assert line.link.read().ends


def test_a_stop_stays_and_only_grows(line: Line) -> None:
    line.ask("stop")
    assert line.link.read().halt is Halt.ORDERLY
    line.ask("off")
    line.ask("stop")
    assert line.link.read().halt is Halt.AT_ONCE


def test_a_start_forgets_the_stop_before_it_and_heeds_the_one_after(line: Line) -> None:
    """Loading a policy takes seconds: whoever presses stop meanwhile means the run to come."""
    line.ask("stop")
    line.link.read()
    line.ask("start", task="walk", set={"vx": "0.1"})
    request = line.link.take("start")
    assert request is not None
    assert (request.task, request.set) == ("walk", {"vx": "0.1"})
    assert line.link.take("start") is None
    assert line.link.read().halt is Halt.NO
    line.ask("stop")
    line.link.begin(INFO)
    assert line.link.read().halt is Halt.ORDERLY


def test_truth_is_shown_on_demand_alone(line: Line) -> None:
    seen = []
    settings = RunSettings("walk", policy="gait", seconds=0.2)
    _, body = prepare(settings)
    assert body.simulation is not None
    line.link.begin(INFO, body.simulation.truth)

    def show(record: TickRecord) -> None:
        line.link(record)
        line.link.read()
        seen.extend(value for kind, value in line.told() if kind == "tick")
        if record.tick == 20:
            line.ask("truth", on=True)

    run(settings, backend=body, on_tick=show)
    truths = [snapshot.truth for snapshot in seen]  # type: ignore[attr-defined]
    assert all(truth is None for truth in truths[:22])
    assert all(truth is not None for truth in truths[22:])
    estimate = seen[-1].pose  # type: ignore[attr-defined]
    np.testing.assert_allclose(truths[-1].joints, estimate.joints, atol=0.05)


def test_rubbish_from_the_page_is_no_wish(line: Line) -> None:
    for data in (b"rubbish", b"{}", b"\x00" * 5000, b'{"kind":"stop"}'):
        line.page.send(data)
    assert line.link.read().halt is Halt.NO
    assert line.link.alive


def test_what_is_asked_for_on_a_panel_arrives_in_its_order_and_the_newest_panel_is_shown(line: Line) -> None:
    line.ask("do", what="save", value="wave")
    line.ask("do", what="play", value="")
    assert [request.what for request in line.link.take_actions()] == ["save", "play"]
    assert line.link.take_actions() == []
    for number in range(20_000):  # more than fits any line
        line.link.show(Panel(f"number {number}", ()))
    line.told()
    line.link.show(Panel("the last", (Paragraph("here"),)))
    assert line.told()[-1] == (
        "panel", {"kind": "panel", "title": "the last", "items": [{"is": "paragraph", "text": "here"}]},
    )  # fmt: skip


def test_a_skill_of_the_page_is_wanted_until_something_else_is(line: Line) -> None:
    line.ask("skill", text="wave")
    line.ask("beat", way=(0.0, 0.0, 0.0))
    assert (line.link.read().skill, line.link.read().skills) == ("wave", 1)
    line.ask("skill", text="wave")
    assert line.link.read().skills == 2
    line.ask("beat", way=(1.0, 0.0, 0.0))
    assert line.link.read().skill is None

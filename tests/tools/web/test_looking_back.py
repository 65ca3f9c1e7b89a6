"""A log on the page: its ticks as they were, any moment of it, and logs that were cut short."""

from __future__ import annotations

import json
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from mcap.writer import Writer
from page_line import Line

from servoid.hw.config import ConfigError
from servoid.hw.contracts.control import Adopted, Plan
from servoid.hw.geometry import to_heading
from servoid.stack.log.look_back import LoggedTicks
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.run import RunSettings, run
from servoid.tools.cli import main
from servoid.tools.web.line.snapshot import RunInfo, Snapshot
from servoid.tools.web.view import Player


@pytest.fixture(scope="module")
def recorded(tmp_path_factory: pytest.TempPathFactory) -> tuple[Path, list[TickRecord]]:
    """A log, and the ticks that it is of."""
    path = tmp_path_factory.mktemp("log") / "run.mcap"
    ticks: list[TickRecord] = []
    run(RunSettings("goal", policy="gait", seconds=3.0, record=path, seed=1), on_tick=ticks.append)
    return path, ticks


def test_a_tick_is_read_as_it_was(recorded: tuple[Path, list[TickRecord]]) -> None:
    path, ticks = recorded
    logged = LoggedTicks(path)
    assert len(logged) == len(ticks)
    assert logged.complete
    for row in (0, 60, 120, len(ticks) - 1):
        found, was = logged.record(row), ticks[row]
        assert (found.tick, found.phase, found.timing) == (was.tick, was.phase, was.timing)
        np.testing.assert_array_equal(found.observation.position, was.observation.position)
        np.testing.assert_array_equal(found.command.position, was.command.position)
        if was.state is not None:
            assert found.state is not None
            np.testing.assert_allclose(found.state.displacement, was.state.displacement, atol=1e-6)
        asked = was.proposal.instruction
        assert (found.proposal.instruction is None) == (asked is None)
        if asked is not None:
            assert found.proposal.instruction is not None
            np.testing.assert_allclose(found.proposal.instruction.goal, asked.goal, atol=1e-6)  # type: ignore[arg-type]
    assert [event.text for event in logged.events] == [event.text for record in ticks for event in record.events]
    assert logged.at(logged.times[77] + 0.001) == 77


def test_the_page_goes_to_the_moment_that_somebody_asks_for(recorded: tuple[Path, list[TickRecord]]) -> None:
    line, logged = Line(), LoggedTicks(recorded[0])
    player = Player(line.link, [logged], "op3")
    line.ask("play", on=False)
    line.ask("seek", at=2.5)
    line.told()
    player.look()
    told = line.told()
    assert [kind for kind, _ in told[:2]] == ["run", "end"]
    infos = [value for _, value in told if isinstance(value, RunInfo)]
    assert infos[0].length == pytest.approx(logged.times[-1])
    shown = [value for _, value in told if isinstance(value, Snapshot)]
    assert shown[-1].time == pytest.approx(2.5, abs=0.021)
    assert shown[0].time == 0.0  # what was before comes along
    player.look()
    assert line.told() == []  # it stands still


def test_a_log_that_was_cut_short_can_be_looked_at(recorded: tuple[Path, list[TickRecord]], tmp_path: Path) -> None:
    whole = recorded[0].read_bytes()
    (tmp_path / "cut.mcap").write_bytes(whole[: len(whole) // 2])
    logged = LoggedTicks(tmp_path / "cut.mcap")
    assert 0 < len(logged) < len(recorded[1])
    assert not logged.complete
    line = Line()
    Player(line.link, [logged], "op3")
    assert ("cut short", "The log was cut short: it does not tell how the run ended.") in [
        value for _, value in line.told()
    ]


def test_what_is_no_log_is_refused(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    (tmp_path / "text.mcap").write_text("text")
    with pytest.raises(ConfigError, match="not a flight log"):
        LoggedTicks(tmp_path / "text.mcap")
    assert main(["view", str(tmp_path / "none.mcap")]) == 2
    assert "none.mcap: cannot be read" in capsys.readouterr().err


def test_an_intent_is_read_as_it_was(tmp_path: Path) -> None:
    from servoid.hw.contracts.operator import Halt, Intent
    from servoid.stack.log.format import intent_message, plain, read_intent

    intent = Intent(7, 0.25, np.array([0.1, 0.0, -1.0]), np.array([1.0, 2.0]), "turn left", True, Halt.ORDERLY)
    for one in (intent, replace(intent, age=float("inf"), goal=None, text=None)):
        found = read_intent(plain(intent_message(one)))
        assert (found.sequence, found.age, found.text, found.ends, found.halt) == (
            one.sequence, one.age, one.text, one.ends, one.halt,
        )  # fmt: skip
        np.testing.assert_array_equal(found.way, one.way)
        assert (found.goal is None) == (one.goal is None)


def test_two_logs_begin_their_task_together_and_stand_side_by_side(
    recorded: tuple[Path, list[TickRecord]], tmp_path: Path
) -> None:
    run(RunSettings("walk", policy="gait", seconds=2.0, record=tmp_path / "other.mcap", seed=2, set={"vx": "0.2"}))
    line, logs = Line(), [LoggedTicks(recorded[0]), LoggedTicks(tmp_path / "other.mcap")]
    player = Player(line.link, logs, "op3")
    told = [value for _, value in line.told()]
    info = next(value for value in told if isinstance(value, RunInfo))
    assert [event.text[:3] for event in info.events].count("2: ") == len(logs[1].events)
    assert any("1: How it ended: " in str(value) and " 2: How it ended: " in str(value) for value in told)
    line.ask("play", on=False)
    begins = [next(event.time for event in log.events if event.text == "running") for log in logs]
    line.ask("seek", at=begins[0] + 1.0)
    player.look()
    shown = [value for _, value in line.told() if isinstance(value, Snapshot)][-1]
    assert shown.phase == "running"
    assert shown.other is not None
    assert shown.other.phase == "running"
    row = logs[1].at(shown.other.time)
    np.testing.assert_array_equal(shown.other.position, logs[1].record(row).observation.position)
    assert shown.time - begins[0] == pytest.approx(shown.other.time - begins[1], abs=0.03)


def test_logs_of_two_robots_are_not_compared(
    recorded: tuple[Path, list[TickRecord]], tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    other = tmp_path / "wren.mcap"
    run(RunSettings("stand", robot="wren", policy="gait", seconds=0.2, record=other))
    assert main(["view", str(recorded[0]), str(other)]) == 2
    assert f"{other}: is of wren, and {recorded[0]} of op3: two logs must be of one robot" in capsys.readouterr().err
    assert main(["view", *[str(other)] * 3]) == 2
    assert "3 logs: at most 2" in capsys.readouterr().err


def test_a_plan_is_shown_against_what_came_of_it(recorded: tuple[Path, list[TickRecord]]) -> None:
    """Of a plan that is made up: where the robot really went, but 5 cm to the left at its end."""
    logged, row = LoggedTicks(recorded[0]), 180
    was = [logged.record(i).state for i in range(row, row + 9)]
    assert all(state is not None for state in was)
    start, rest = was[0], was[1:]
    ahead = np.array([to_heading(state.displacement[:2], start) for state in rest])  # type: ignore[union-attr, arg-type]
    plan = Plan(0, np.zeros((8, 20)), np.zeros((8, 1)), ahead + np.linspace(0.0, 0.05, 8)[:, None] * [0.0, 1.0], 0.01)
    record = logged.record(row + 2)
    adopted = replace(record, proposal=replace(record.proposal, plan=Adopted(5, 7, plan)))
    came = Player(Line().link, [logged], "op3").outcome(row + 2, adopted)
    assert came is not None
    np.testing.assert_allclose(came.places, [state.displacement[:2] for state in rest])  # type: ignore[union-attr]
    assert (came.off, came.ticks) == (pytest.approx(0.05, abs=1e-6), 8)
    last = logged.record(len(logged) - 2)
    unknown = replace(last, proposal=replace(last.proposal, plan=Adopted(0, 500, plan)))
    assert Player(Line().link, [logged], "op3").outcome(len(logged) - 2, unknown) is None


@pytest.mark.parametrize("version", [1, 99])
def test_a_log_of_another_version_is_one_clear_line(
    recorded: tuple[Path, list[TickRecord]], tmp_path: Path, capsys: pytest.CaptureFixture[str], version: int
) -> None:
    log = tmp_path / "other.mcap"
    with log.open("wb") as file:
        writer = Writer(file)
        writer.start()
        channel = writer.register_channel("/run", "json", writer.register_schema("run", "jsonschema", b"{}"))
        writer.add_message(channel, 0, json.dumps({"format": version, "robot": {}}).encode(), 0)
        writer.finish()
    assert main(["view", str(log)]) == 2
    (said,) = capsys.readouterr().err.splitlines()
    assert f"{log}: " in said
    assert "format" in said or "version" in said

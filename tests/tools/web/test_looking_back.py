"""A log on the page: its ticks as they were, any moment of it, and logs that were cut short."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest
from page_line import Line

from servoid.hw.config import ConfigError
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
    player = Player(line.link, logged, "op3")
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
    Player(line.link, logged, "op3")
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

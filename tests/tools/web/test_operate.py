"""Tasks that are started from the page, and pages that cannot be opened."""

from __future__ import annotations

import argparse
import io
import socket
from pathlib import Path

import pytest
from page_line import Line

from servoid.tools.cli import main
from servoid.tools.common.output import Report
from servoid.tools.web import operate
from servoid.tools.web.line.messages import PageRequest


def arguments(folder: Path) -> argparse.Namespace:
    return argparse.Namespace(
        backend="sim", robot="op3", policy="gait", gain=1.0, port=None, recover=False, logs=folder / "runs"
    )


def test_a_task_is_run_as_the_page_asks_and_the_page_is_told_how_it_ended(tmp_path: Path) -> None:
    line, said = Line(), io.StringIO()
    request = PageRequest("start", 1, 0.0, task="stand", set={"seconds": "1"}, on=True, gain=0.9)
    operate.run_task(Report(False, said), arguments(tmp_path), line.link, request, seed=0)
    assert "stand: succeeded after 1.0 s" in said.getvalue()
    told = line.told()
    assert told[0][0] == "run"
    assert told[-1] == ("end", ("succeeded", "The task succeeded."))
    assert len(list((tmp_path / "runs").glob("*-stand.mcap"))) == 1


def test_a_wrong_setting_is_told_at_the_page_and_ends_nothing(tmp_path: Path) -> None:
    line, said = Line(), io.StringIO()
    request = PageRequest("start", 1, 0.0, task="walk", set={"speed": "1"})
    operate.run_task(Report(False, said), arguments(tmp_path), line.link, request, seed=0)
    kind, (outcome, text) = line.told()[-1]  # type: ignore[misc]
    assert (kind, outcome) == ("end", "error")
    assert "speed" in text
    assert "speed" in said.getvalue()


def test_a_wish_to_stop_that_came_while_a_task_was_made_ready_stops_it(tmp_path: Path) -> None:
    line, said = Line(), io.StringIO()
    line.ask("stop")
    request = PageRequest("start", 1, 0.0, task="stand", set={"seconds": "600"})
    operate.run_task(Report(False, said), arguments(tmp_path), line.link, request, seed=0)
    assert "stand: interrupted" in said.getvalue()


@pytest.mark.parametrize(
    ("words", "told"),
    [
        (["run", "walk", "--view", "--view-host", "my robot"], "--view-host 'my robot': give the address"),
        (["run", "walk", "--view", "--view-port", "70000"], "--view-port 70000: give a number from 0"),
        (["run", "steer", "--view", "--set", "device=gamepad"], "with --view the page steers"),
        (["operate", "--backend", "hydraulic"], "hydraulic"),
    ],
)
def test_a_page_that_cannot_be_opened_is_one_clear_line(
    words: list[str], told: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main(words) == 2
    assert told in capsys.readouterr().err


@pytest.mark.slow
def test_a_port_that_is_taken_is_one_clear_line(capsys: pytest.CaptureFixture[str]) -> None:
    with socket.create_server(("127.0.0.1", 0)) as taken:
        port = taken.getsockname()[1]
        assert main(["run", "stand", "--policy", "gait", "--view", "--view-port", str(port)]) == 2
    assert f"port {port}: Address already in use: choose another with --view-port" in capsys.readouterr().err

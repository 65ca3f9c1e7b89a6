"""`servoid export`: a log as tables that other programs read."""

from __future__ import annotations

import csv
import json
from pathlib import Path
from typing import Any

import numpy as np
import pytest

from servoid.hw.robot.description import load_robot
from servoid.stack.log.flightlog import FlightLog, read_log
from servoid.tools.cli import main

ROBOT = load_robot()


@pytest.fixture(scope="module")
def log(tmp_path_factory: pytest.TempPathFactory) -> FlightLog:
    path = tmp_path_factory.mktemp("log") / "stand.mcap"
    assert main(["run", "stand", "--policy", "gait", "--seconds", "0.5", "--fast", "--record", str(path)]) == 0
    return read_log(path)


def export(log: FlightLog, capsys: pytest.CaptureFixture[str], *words: Any) -> tuple[int, dict[str, Any]]:
    code = main(["export", str(log.path), *map(str, words), "--json"])
    return code, json.loads(capsys.readouterr().out.splitlines()[-1])


def test_every_number_of_the_log_is_in_its_cell(
    log: FlightLog, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    code, answer = export(log, capsys, "--csv", "--out", tmp_path)
    assert (code, answer["ticks"]["rows"]) == (0, len(log.ticks("/observation")))
    with open(tmp_path / "stand-ticks.csv") as file:
        rows = list(csv.DictReader(file))
    knee = ROBOT.names.index("l_knee")
    cells = [float(row["observation.position.l_knee"]) for row in rows]
    np.testing.assert_array_equal(cells, log.column("/observation", "position")[:, knee])
    assert [row["command.phase"] for row in rows] == [m["phase"] for m in log.messages["/command"]]
    np.testing.assert_allclose([float(row["time"]) for row in rows], np.arange(len(rows)) * ROBOT.dt)
    told = [row for row in rows if row["instruction.velocity.x"]]
    assert [int(row["tick"]) for row in told] == log.ticks("/instruction").tolist(), "empty where nothing was asked"
    assert {row["observation.temperature.l_knee"] for row in rows} == {""}, "not measured is empty, and not zero"
    with open(tmp_path / "stand-events.csv") as file:
        assert [row["text"] for row in csv.DictReader(file)] == [event["text"] for event in log.messages["/event"]]


def test_parquet_holds_the_same(log: FlightLog, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    parquet = pytest.importorskip("pyarrow.parquet")
    assert export(log, capsys, "--parquet", "--out", tmp_path)[0] == 0
    table = parquet.read_table(tmp_path / "stand-ticks.parquet").to_pydict()
    np.testing.assert_array_equal(table["state.yaw"][-10:], log.column("/state", "yaw")[-10:].astype(float))


def test_tables_that_are_there_are_kept(log: FlightLog, tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    assert export(log, capsys, "--csv", "--out", tmp_path)[0] == 0
    code, answer = export(log, capsys, "--csv", "--out", tmp_path)
    assert code == 2
    assert "stand-ticks.csv: already exists: use --replace" in answer["error"]
    assert export(log, capsys, "--csv", "--out", tmp_path, "--replace")[0] == 0


def test_what_there_is_of_a_cut_log_is_written(
    log: FlightLog, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    cut = tmp_path / "cut.mcap"
    cut.write_bytes(log.path.read_bytes()[: int(0.7 * log.path.stat().st_size)])
    code, answer = export(read_log(cut), capsys, "--csv")
    assert code == 0
    assert not answer["complete"]
    assert 0 < answer["ticks"]["rows"] < len(log.ticks("/observation"))

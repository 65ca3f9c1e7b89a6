"""`servoid bench kill` and `bench interrupt`, a few of each: a real run on a rig in real time ends with torque off."""

from __future__ import annotations

import json
from typing import Any

import pytest

from tools.cli import main


def figures(words: list[str], capfd: pytest.CaptureFixture[str]) -> dict[str, Any]:
    code = main([*words, "--json"])
    out, err = capfd.readouterr()
    assert code == 0, err
    values: dict[str, Any] = json.loads(out)
    return values


def test_a_controller_that_is_killed_leaves_no_torque_and_a_log(capfd: pytest.CaptureFixture[str]) -> None:
    """By the rig's own record: the guardian within 100 ms; and with it killed too, the watchdog. The second is the
    machine's patience as much as the guardian's, so that it may be busy."""
    values = figures(["bench", "kill", "--kills", "2", "--unguarded", "1"], capfd)
    assert values["runs"] == values["all_damped"] == values["all_off"] == 2
    assert values["unguarded_runs"] == values["unguarded_all_stopped"] == 1
    assert values["logs_read"] == 3
    assert 30.0 < values["median_ms"] <= values["worst_ms"] < 1000.0
    assert 60.0 < values["unguarded_worst_ms"] < 300.0


def test_ctrl_c_ends_with_torque_off_that_all_servos_acknowledged(capfd: pytest.CaptureFixture[str]) -> None:
    values = figures(["bench", "interrupt", "--times", "2"], capfd)
    assert values["runs"] == values["all_off"] == 2
    assert values["guardian_needed"] == 0
    assert values["void"] == values["void_all_off"]
    assert set(values["other_codes"]) <= {4}, "on a busy machine the guard may have stopped it a moment before"


def test_what_cannot_be_counted_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bench", "kill", "--kills", "-1"]) == 2
    assert main(["bench", "interrupt", "--times", "0"]) == 2
    assert "give numbers from 1 on" in capsys.readouterr().err

"""`servoid bench soak`: a few seconds of it, which find the losses absorbed."""

from __future__ import annotations

import json
import os
from types import SimpleNamespace

import pytest

from servoid.tools.cli import main
from servoid.tools.faults.soak import rss_mb

TRIES = 3  # in real time a machine that is busy enough stops any walk


@pytest.mark.slow
def test_a_walk_goes_on_over_a_line_that_loses_packets(capsys: pytest.CaptureFixture[str]) -> None:
    for _ in range(TRIES):
        assert main(["bench", "soak", "--minutes", "0.05", "--warm-up", "1", "--share", "0.02", "--json"]) == 0
        result = json.loads(capsys.readouterr().out)
        if not result["stopped"]:
            break
    assert result["outcome"] == "succeeded", result["events"]
    assert not result["fell"]
    assert result["packets_struck"] > 20
    assert result["answers_lost"] > 20
    assert result["ticks"] >= 100
    assert result["late_p99_ms"] >= result["late_p50_ms"] >= 0.0
    assert result["rss_end_mb"] > 0.0 < result["rig_rss_end_mb"]


@pytest.mark.parametrize("outcome", ["fell", "succeeded"])
def test_a_fall_that_the_guard_saw_is_a_fall(
    outcome: str, monkeypatch: pytest.MonkeyPatch, capsys: pytest.CaptureFixture[str]
) -> None:
    """The truth is looked at once a second, and a run that fell ends before the next look."""
    monkeypatch.setattr("servoid.stack.runtime.run.run", lambda *_, **__: SimpleNamespace(outcome=outcome, events=()))
    assert main(["bench", "soak", "--json"]) == 0
    assert json.loads(capsys.readouterr().out)["fell"] == (outcome == "fell")


def test_memory_is_that_of_the_process_asked_for() -> None:
    assert rss_mb(os.getpid()) == pytest.approx(rss_mb(), rel=0.1)
    assert rss_mb() > 10.0

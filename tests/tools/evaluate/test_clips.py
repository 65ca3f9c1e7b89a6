"""Clips are recorded once, and what ended a recording is not taken for what the expert did."""

from __future__ import annotations

from pathlib import Path
from types import SimpleNamespace

import pytest

from servoid.stack.runtime.run import RunSettings
from servoid.tools.evaluate import clips


def test_ctrl_c_while_a_clip_is_recorded_is_no_fall(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    """Else that walk is left out ever after."""

    def run(settings: RunSettings) -> SimpleNamespace:
        assert settings.record is not None
        settings.record.touch()
        return SimpleNamespace(interrupted=True, outcome="stopped")

    monkeypatch.setattr("servoid.stack.runtime.run.run", run)
    told: list[str] = []
    with pytest.raises(KeyboardInterrupt):
        clips.record_clips(tmp_path, "op3", 1, told.append)
    assert "walk-7000000.mcap" in told[0]
    assert not list(tmp_path.rglob("*.fell"))

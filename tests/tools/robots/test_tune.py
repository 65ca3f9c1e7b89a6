"""Searches that take long: what would lose their outcome is said before they begin."""

from __future__ import annotations

from pathlib import Path

import pytest

from servoid.hw.config import ConfigError
from servoid.tools.cli import main
from servoid.tools.common.output import check_writable


@pytest.mark.parametrize("verb", ["gait", "kick"])
def test_a_place_that_cannot_be_written_is_refused_before_the_search(
    verb: str, tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    """The kick's was found out after the first generation, the gait's after the last."""
    pytest.importorskip("cma")
    assert main(["tune", verb, "--out", str(tmp_path)]) == 2
    captured = capsys.readouterr()
    assert captured.out == ""
    assert captured.err.count("\n") == 1
    assert "cannot be written (Is a directory): choose another place with --out" in captured.err


def test_looking_whether_a_file_can_be_written_changes_nothing(tmp_path: Path) -> None:
    kept = tmp_path / "kept.yaml"
    kept.write_text("kept")
    check_writable(kept)
    assert kept.read_text() == "kept"
    check_writable(tmp_path / "new" / "new.yaml")
    assert not list((tmp_path / "new").iterdir())
    with pytest.raises(ConfigError, match="Is a directory"):
        check_writable(tmp_path)

"""Searches that take long: what would lose their outcome is said before they begin."""

from __future__ import annotations

from pathlib import Path

import pytest

from servoid.hw.config import ConfigError, load_yaml
from servoid.hw.robot.description import load_robot
from servoid.policy.references.gait import GaitSettings, gait_of
from servoid.tools.cli import main
from servoid.tools.common.output import check_writable
from servoid.tools.robots import tune_gait
from servoid.tools.robots.tune_gait import Walked


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


def test_steps_by_which_every_walk_fell_are_not_written(tmp_path: Path) -> None:
    robot, out = load_robot("wren"), tmp_path / "gait.yaml"
    assert not tune_gait._write(out, robot, gait_of(robot), Walked(7.0, 1.0, 0.0))
    assert not out.exists()
    assert tune_gait._write(out, robot, gait_of(robot), Walked(6.0, 0.9, 0.2))
    assert load_yaml(out, GaitSettings).cycle == pytest.approx(gait_of(robot).cycle, abs=1e-4)

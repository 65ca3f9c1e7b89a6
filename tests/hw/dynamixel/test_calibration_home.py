"""Users without home or name, and a home that cannot be written: said before the work, and nothing is lost."""

from __future__ import annotations

import os
from collections.abc import Callable
from pathlib import Path

import pytest

from servoid.hw.config import ConfigError
from servoid.hw.dynamixel.calibration import (
    Calibration,
    JointCalibration,
    as_text,
    calibrated,
    calibration_path,
    check_writable,
    load_calibration,
    save_calibration,
)
from servoid.hw.dynamixel.guardian_client import log_path
from servoid.hw.robot.description import load_robot
from servoid.tools.bringup.calibrate import keep

ROBOT = load_robot()
MEASURED = Calibration("op3", "2026-01-01T00:00:00", "zero", {"l_knee": JointCalibration(14, "xm430-w350", 1, 0.1)})
NOBODY = 54321  # a user ID without a name


def as_nobody(monkeypatch: pytest.MonkeyPatch, check: Callable[[], None]) -> None:
    """Run `check` in a process of that user, without a home."""
    for name in ("HOME", "XDG_CONFIG_HOME", "XDG_STATE_HOME"):
        monkeypatch.delenv(name, raising=False)
    pid = os.fork()
    if pid == 0:
        code = 1
        try:
            os.setgroups([])
            os.setuid(NOBODY)
            check()
            code = 0
        finally:
            os._exit(code)
    assert os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1]) == 0


root = pytest.mark.skipif(os.getuid() != 0, reason="only root can be another user")


@root
def test_a_user_without_home_and_name_can_drive_and_is_told_where_to_calibrate(monkeypatch: pytest.MonkeyPatch) -> None:
    def check() -> None:
        with pytest.raises(ConfigError, match="no home folder: set XDG_CONFIG_HOME"):
            calibration_path(ROBOT)
        robot, text = calibrated(ROBOT)
        assert robot == ROBOT
        assert "not calibrated" in text
        assert log_path() is None

    as_nobody(monkeypatch, check)


@root
def test_a_home_that_cannot_be_written_is_found_before_the_work(
    monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    tmp_path.chmod(0o755)

    def check() -> None:
        with pytest.raises(ConfigError, match=r"cannot be written: .*: set XDG_CONFIG_HOME to your own folder"):
            check_writable(tmp_path / "calibration" / "op3.yaml")

    as_nobody(monkeypatch, check)


def test_checking_leaves_nothing_behind_and_needs_no_hard_links(tmp_path: Path) -> None:
    path = tmp_path / "new" / "op3.yaml"
    check_writable(path)
    assert list(path.parent.iterdir()) == []
    save_calibration(MEASURED, path)
    check_writable(path)
    earlier = save_calibration(MEASURED, path)
    assert earlier is not None
    assert {file.name for file in path.parent.iterdir()} == {"op3.yaml", earlier.name}
    assert earlier.stat().st_nlink == 1, "a copy: a memory card knows no hard links"
    with pytest.raises(ConfigError, match="it is a folder"):
        check_writable(path.parent)


def test_what_was_measured_is_kept_though_the_folder_went_away(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    (tmp_path / "gone").write_text("a file now")
    path = tmp_path / "gone" / "op3.yaml"
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path))
    with pytest.raises(ConfigError, match="what was measured is kept in ") as caught:
        keep(MEASURED, path)
    (kept,) = tmp_path.glob("servoid-calibration-*.yaml")
    assert f"{kept}: copy it to {path}" in str(caught.value)
    assert load_calibration(kept) == MEASURED
    monkeypatch.setattr("tempfile.tempdir", str(tmp_path / "gone"))
    with pytest.raises(ConfigError) as last:
        keep(MEASURED, path)
    assert last.value.__notes__ == [as_text(MEASURED)], "shown, if it can be kept nowhere"

"""Two programs with one output folder: the second one is told of the first, and touches nothing."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from servoid.hw.config import ConfigError
from servoid.tools.cli import main
from servoid.tools.common.folder_lock import locked

HOLD = """
import sys, time
from pathlib import Path
from servoid.tools.common.folder_lock import locked
with locked(Path(sys.argv[1])):
    print("held", flush=True)
    time.sleep(600)
"""


@pytest.fixture
def holder(tmp_path: Path) -> Iterator[subprocess.Popen[str]]:
    """Another program that writes into `out`."""
    command = [sys.executable, "-c", HOLD, str(tmp_path / "out")]
    process = subprocess.Popen(command, stdout=subprocess.PIPE, text=True)
    assert process.stdout is not None
    assert process.stdout.readline() == "held\n"
    yield process
    process.kill()
    process.wait()
    process.stdout.close()


def test_a_second_program_is_told_who_writes_there(holder: subprocess.Popen[str], tmp_path: Path) -> None:
    message = rf"out: `-c .*out` \(process {holder.pid}\) is writing there: wait for it, or choose another folder"
    with pytest.raises(ConfigError, match=message), locked(tmp_path / "out"):
        pass


@pytest.mark.parametrize(
    "words",
    [
        ("collect", "--frames", "10", "--worlds", "1", "--policy", "gait", "--force"),
        ("evaluate", "papers", "--rows", "uniphys/goal-near", "--episodes", "1"),
    ],
)
def test_verbs_leave_a_folder_alone_that_another_writes_to(
    holder: subprocess.Popen[str], tmp_path: Path, capsys: pytest.CaptureFixture[str], words: tuple[str, ...]
) -> None:
    """The second `collect` deleted what the first had written."""
    mark = tmp_path / "out.part" / "begun"
    mark.parent.mkdir()
    mark.touch()
    assert main([*words, "--out", str(tmp_path / "out")]) == 2
    assert f"(process {holder.pid}) is writing there" in capsys.readouterr().err
    assert mark.exists()


def test_a_killed_program_holds_nothing(holder: subprocess.Popen[str], tmp_path: Path) -> None:
    os.kill(holder.pid, signal.SIGKILL)
    holder.wait()
    with locked(tmp_path / "out"):
        assert (tmp_path / ".out.lock").exists()
    assert not (tmp_path / ".out.lock").exists()


def test_a_folder_is_free_again_after_an_error(tmp_path: Path) -> None:
    with pytest.raises(RuntimeError), locked(tmp_path / "out"):
        raise RuntimeError
    with locked(tmp_path / "out"), locked(tmp_path / "other"):
        pass


def test_a_place_that_cannot_be_written_is_said(tmp_path: Path) -> None:
    (tmp_path / "file").touch()
    with (
        pytest.raises(ConfigError, match=r"out: cannot be written \(.*\): choose another place"),
        locked(tmp_path / "file" / "out"),
    ):
        pass

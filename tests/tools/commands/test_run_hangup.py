"""A terminal that is closed, and one that asks to freeze, while a robot walks: it comes to rest and is lowered."""

from __future__ import annotations

import contextlib
import os
import pty
import sys
from pathlib import Path

import pytest

from servoid.stack.log.flightlog import read_log


def start(log: Path) -> tuple[int, int]:
    """A run in a terminal of its own: process ID, and our end of the terminal."""
    words = ["run", "walk", "--backend", "virtual", "--policy", "gait", "--seconds", "600", "--record", str(log)]
    pid, terminal = pty.fork()
    if pid == 0:
        os.execv(sys.executable, [sys.executable, "-m", "servoid", *words])
    return pid, terminal


def read_until(terminal: int, word: bytes) -> None:
    seen = b""
    while word not in seen:
        seen += os.read(terminal, 4096)


def code_of(pid: int) -> int:
    return os.waitstatus_to_exitcode(os.waitpid(pid, 0)[1])


@pytest.mark.slow
@pytest.mark.parametrize("how", ["closed", "Ctrl-Z", "Ctrl-\\"])
def test_it_ends_as_after_ctrl_c(tmp_path: Path, how: str) -> None:
    log = tmp_path / "run.mcap"
    pid, terminal = start(log)
    read_until(terminal, b"tilt")
    read_until(terminal, b" s  asked")
    if how == "closed":
        os.close(terminal)
    else:
        os.write(terminal, {"Ctrl-Z": b"\x1a", "Ctrl-\\": b"\x1c"}[how])
        with contextlib.suppress(OSError):
            while os.read(terminal, 4096):  # a terminal that nobody reads fills up
                pass
        os.close(terminal)
    assert code_of(pid) == 130
    found = read_log(log)
    assert found.complete
    assert found.result is not None
    assert found.result["outcome"] == "interrupted"
    phases = [event["text"] for event in found.messages["/event"] if event["kind"] == "phase"]
    assert phases[-3:] == ["coming to rest", "lowering", "damped"]

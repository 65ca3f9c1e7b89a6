"""The stop button while a policy hangs, and at any instant of a walk, over the page's own line."""

from __future__ import annotations

import json
import subprocess
import sys
from contextlib import ExitStack
from pathlib import Path
from typing import Any

import pytest
from waiting import until
from websockets.sync.client import connect

pytestmark = pytest.mark.slow

HANGS = """
import time
from servoid.stack.control.base import BasePolicy

class Hangs(BasePolicy):
    def __init__(self, robot):
        self.ticks = 0

    def act(self, state, applied, instruction):
        self.ticks += 1
        if self.ticks == 30:
            print("it hangs", flush=True)
            while True:
                time.sleep(0.1)
        return applied
"""


class Run:
    """A run with a page, and somebody at it."""

    def __init__(self, folder: Path, *words: str) -> None:
        line = [sys.executable, "-m", "servoid.tools.cli", "run", *words, "--view", "--view-port", "0"]
        self.process = subprocess.Popen(line, stdout=subprocess.PIPE, stderr=subprocess.STDOUT, text=True, cwd=folder)
        url = self.line("page: ").split()[1]
        self._open = ExitStack()
        origin: Any = url.rstrip("/")
        self.browser = self._open.enter_context(connect(url.replace("http", "ws") + "control", origin=origin))
        self._sequence = 0

    def line(self, beginning: str) -> str:
        """Wait for a line of the command that begins so."""
        assert self.process.stdout is not None
        for line in self.process.stdout:
            if line.startswith(beginning):
                return line
        raise AssertionError(f"no line '{beginning}'")

    def ask(self, kind: str) -> None:
        self._sequence += 1
        self.browser.send(json.dumps({"kind": kind, "sequence": self._sequence, "time": 0.0}))

    def phase(self) -> str:
        """The next one that the page shows."""
        while (message := json.loads(self.browser.recv()))["kind"] != "tick":
            pass
        return str(message["phase"])

    def close(self) -> int:
        self._open.close()
        self.said = self.process.communicate()[0]
        return self.process.returncode


def test_stop_works_while_a_policy_hangs(tmp_path: Path) -> None:
    """It never looks whether somebody asked to stop, so it is broken off, and torque goes off at once."""
    (tmp_path / "hangs.py").write_text(HANGS)
    run = Run(tmp_path, "walk", "--policy", "hangs.py:Hangs", "--record", "run.mcap")
    run.line("it hangs")
    run.ask("stop")
    assert run.close() == 130
    assert "interrupted twice: torque off at once" in run.said


def test_stop_lowers_a_walk_and_torque_off_does_not(tmp_path: Path) -> None:
    for kind, seen in (("stop", {"stopping", "lowering"}), ("off", {"damped"})):
        run = Run(tmp_path, "walk", "--policy", "gait", "--seconds", "600", "--set", "vx=0.1")
        until(lambda run=run: run.phase() == "running")
        run.ask(kind)
        until(lambda run=run, seen=seen: run.phase() in seen)
        assert run.close() == 130

"""Ctrl-C at start-up: one line and 130, in every verb and every process, however deep in an import it falls."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
import time
from pathlib import Path

import pytest

WHILE_IMPORTING = """
import signal, sys
from servoid.hw.signals import raise_interrupts
sys.path.insert(0, sys.argv[1])
raise_interrupts()
try:
    import interrupted
    signal.pause()
except KeyboardInterrupt:
    print(sys.modules["interrupted"].whole)
"""
WHILE_DESTROYED = """
import signal
from servoid.hw.signals import raise_interrupts
class Destroyed:
    def __del__(self): signal.raise_signal(signal.SIGINT)
raise_interrupts()
try:
    Destroyed()
    signal.pause()
except KeyboardInterrupt:
    print("raised")
"""


def test_an_interrupt_waits_for_the_import_that_it_falls_into(tmp_path: Path) -> None:
    """A compiled module would end it as "ImportError: initialization failed"."""
    (tmp_path / "interrupted.py").write_text("import signal\nsignal.raise_signal(signal.SIGINT)\nwhole = True\n")
    result = subprocess.run(
        [sys.executable, "-c", WHILE_IMPORTING, tmp_path], capture_output=True, text=True, timeout=60
    )
    assert (result.stdout, result.stderr) == ("True\n", "")


def test_an_interrupt_that_a_destructor_swallows_comes_again() -> None:
    result = subprocess.run([sys.executable, "-c", WHILE_DESTROYED], capture_output=True, text=True, timeout=60)
    assert (result.stdout, result.stderr) == ("raised\n", "")


def test_no_second_python_is_started_to_find_a_library() -> None:
    """It would get Ctrl-C too, and answer with a traceback from deep in its own start."""
    source = (
        "import subprocess, sys\n"
        "sys.addaudithook(lambda event, words: event == 'subprocess.Popen' and print(words[0], words[1]))\n"
        "from servoid.tools.start import main\n"
        "sys.argv = ['servoid', 'tasks']\n"
        "main()\nimport mujoco.rendering.classic.gl_context\n"
    )
    result = subprocess.run([sys.executable, "-c", source], capture_output=True, text=True, env=os.environ)
    assert sys.executable not in result.stdout
    assert result.stderr == ""


def interrupted(words: str, after: float, times: int) -> tuple[int, str]:
    """Exit code and standard error of a command whose processes all get SIGINT so long after its start, as from a
    terminal."""
    command = [sys.executable, "-m", "servoid", *words.split()]
    with subprocess.Popen(
        command, stdout=subprocess.DEVNULL, stderr=subprocess.PIPE, text=True, start_new_session=True
    ) as process:
        time.sleep(after)
        for _ in range(times):
            if process.poll() is None:
                os.killpg(process.pid, signal.SIGINT)
            time.sleep(0.03)
        _, errors = process.communicate()
    return process.returncode, errors


@pytest.mark.slow
@pytest.mark.parametrize("times", [1, 2])
@pytest.mark.parametrize(
    "words",
    [
        "tasks",
        "run stand --policy gait --fast --record {}/a.mcap",
        "rollout stand --policy gait --workers 2 --episodes 2 --seconds 1",
        "evaluate papers --list",
        "bench sim",
    ],
)
def test_ctrl_c_at_any_instant_of_the_start_is_one_line(words: str, times: int, tmp_path: Path) -> None:
    for number in range(6):
        folder = tmp_path / str(number)
        folder.mkdir()
        code, errors = interrupted(words.format(folder), 0.3 + 0.45 * number, times)
        assert "Traceback" not in errors
        assert "internal error" not in errors
        assert code in (0, 130)
        assert "interrupted" in errors or code == 0 or words.startswith("run")  # whose run may have begun

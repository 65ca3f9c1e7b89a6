"""Fixtures that tests of several packages share."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from synthetic_recording import write_dataset

from servoid.hw.robot.description import load_robot
from servoid.hw.signals import ordinary_stack

# A shell lets what it starts in the background ignore Ctrl-C and Ctrl-\\, and nohup a hang-up. A run leaves alone what
# it finds ignored, and the tests of what these signals do would wait for ever.
for number in (signal.SIGHUP, signal.SIGQUIT, signal.SIGTSTP):
    signal.signal(number, signal.SIG_DFL)
if signal.getsignal(signal.SIGINT) is signal.SIG_IGN:
    signal.signal(signal.SIGINT, signal.default_int_handler)


def pytest_runtest_teardown() -> None:
    """Tests that send a signal to themselves do so without a run, which would see to this."""
    ordinary_stack()


@pytest.fixture(scope="session")
def synthetic_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a small made-up dataset, as `servoid collect` would write it."""
    return write_dataset(tmp_path_factory.mktemp("dataset") / "made-up", load_robot())

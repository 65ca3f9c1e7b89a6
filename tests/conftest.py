"""Fixtures that tests of several packages share."""

from __future__ import annotations

import signal
from pathlib import Path

import pytest
from synthetic_recording import write_dataset

from servoid.hw.robot.description import load_robot

# Under nohup, which leaves a hang-up ignored for all that it starts, tests of what a hang-up does would wait for ever.
signal.signal(signal.SIGHUP, signal.SIG_DFL)


@pytest.fixture(scope="session")
def synthetic_dataset(tmp_path_factory: pytest.TempPathFactory) -> Path:
    """Folder of a small made-up dataset, as `servoid collect` would write it."""
    return write_dataset(tmp_path_factory.mktemp("dataset") / "made-up", load_robot())

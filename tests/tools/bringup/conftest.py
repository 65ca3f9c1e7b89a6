"""One virtual rig for all tests of bring-up: starting one takes seconds. It is reset, with power off, for each."""

from __future__ import annotations

import json
from collections.abc import Callable, Iterator
from pathlib import Path
from typing import Any

import pytest

import servoid.sim.rig.process.backend
import servoid.sim.rig.process.control
from servoid.hw.robot.description import load_robot
from servoid.sim.rig.process.control import RigProcess
from servoid.tools.cli import main


class Lent:
    """The shared rig in the place of a new one: it outlives whoever asked for it."""

    rig: RigProcess

    def __init__(self, *given: Any, **named: Any) -> None:
        self.port, self.control, self.truth = Lent.rig.port, Lent.rig.control, Lent.rig.truth

    def close(self) -> None: ...

    def __enter__(self) -> Lent:
        return self

    def __exit__(self, *exc: object) -> None: ...


@pytest.fixture(scope="session")
def one_rig() -> Iterator[RigProcess]:
    with RigProcess(load_robot(), linger=60.0) as rig:
        yield rig


@pytest.fixture
def rig(one_rig: RigProcess, monkeypatch: pytest.MonkeyPatch) -> RigProcess:
    """The rig behind `--port virtual`."""
    one_rig.control.reset(0)
    one_rig.control.call("accepted")
    Lent.rig = one_rig
    monkeypatch.setattr(servoid.sim.rig.process.control, "RigProcess", Lent)
    monkeypatch.setattr(servoid.sim.rig.process.backend, "RigProcess", Lent)
    return one_rig


@pytest.fixture(autouse=True)
def configuration(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Path:
    """No test sees or touches the calibration of whoever runs it."""
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    return tmp_path


Bringup = Callable[..., tuple[int, dict[str, Any], str]]


@pytest.fixture
def bringup(capfd: pytest.CaptureFixture[str]) -> Bringup:
    """Run a verb with --json: exit code, the object on standard output, and standard error."""

    def call(*words: str) -> tuple[int, dict[str, Any], str]:
        code = main(["bringup", *words, "--json"])
        out, err = capfd.readouterr()
        (line,) = out.splitlines()
        return code, json.loads(line), err

    return call

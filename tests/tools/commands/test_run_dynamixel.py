"""`servoid run --backend dynamixel` on a rig that another process serves, in real time, as a person starts it."""

from __future__ import annotations

import os
import signal
import subprocess
import sys
from collections import Counter
from collections.abc import Iterator
from pathlib import Path

import pytest
from waiting import until

from servoid.hw.clock import WallClock
from servoid.hw.dynamixel.protocol.tables import table
from servoid.hw.dynamixel.transport.bus import Bus
from servoid.hw.dynamixel.transport.port import SerialPort
from servoid.hw.robot.description import load_robot
from servoid.sim.rig.process.control import RigProcess
from servoid.stack.log.flightlog import read_log
from servoid.tools.cli import main
from servoid.tools.faults.controller import free_rig

ROBOT = load_robot()
RUN = ["run", "stand", "--policy", "gait", "--seconds", "1", "--backend", "dynamixel"]
TRIES = 3  # on a machine that is so busy that samples grow old, the guard stops a run


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))


@pytest.fixture(scope="module")
def shared() -> Iterator[RigProcess]:
    with free_rig() as rig:
        yield rig


@pytest.fixture
def rig(shared: RigProcess) -> RigProcess:
    shared.control.reset(0)
    shared.control.accepted()
    return shared


def set_register(rig: RigProcess, joint: str, register: str, value: int) -> None:
    """As another program would, before."""
    port = SerialPort(rig.port, ROBOT.bus.baud)
    bus = Bus(port, WallClock())
    assert bus.write_item(ROBOT.bus.board_id, table("opencr").item("dynamixel_power"), 1)
    id = ROBOT.joints[ROBOT.names.index(joint)].id
    until(lambda: bus.write_item(id, table("xm430-w350").item(register), value))
    port.close()


def written(rig: RigProcess, register: str) -> set[int]:
    return {write["value"] for write in rig.control.accepted() if write["register"] == register}


@pytest.mark.slow
def test_it_stands_more_softly_and_lets_go(rig: RigProcess, capsys: pytest.CaptureFixture[str]) -> None:
    """The same command as on a robot. `gain` is what the servos get: of 800, then none to brake."""
    for i in range(TRIES):
        rig.control.accepted()
        code = main([*RUN, "--port", rig.port, "--start", "--gain", "0.9", "--record", f"{i}.mcap"])
        if code != 4:
            break
        rig.control.reset(0)
    assert code == 0, capsys.readouterr()
    assert written(rig, "position_p_gain") == {720, 0}
    assert not any(servo["torque"] for servo in rig.control.servos())
    log = read_log(f"{i}.mcap")
    assert log.complete
    assert log.header["backend"] == "dynamixel"


def test_it_does_not_move_without_enter_or_start(
    rig: RigProcess, capsys: pytest.CaptureFixture[str], monkeypatch: pytest.MonkeyPatch
) -> None:
    with open(os.devnull) as nobody:
        monkeypatch.setattr(sys, "stdin", nobody)
        assert main([*RUN, "--port", rig.port]) == 2
    assert "give --start" in capsys.readouterr().err
    assert rig.control.accepted() == []


def test_registers_that_differ_are_a_table_and_refused(rig: RigProcess, capsys: pytest.CaptureFixture[str]) -> None:
    set_register(rig, "l_knee", "return_delay_time", 250)
    assert main([*RUN, "--port", rig.port, "--start"]) == 3
    *rows, last = capsys.readouterr().err.strip().splitlines()
    assert [row.split() for row in rows[-2:]] == [
        ["joint", "ID", "register", "found", "wanted"],
        ["l_knee", "14", "return_delay_time", "250", "0"],
    ]
    assert "`servoid bringup check --fix`" in last
    assert rig.control.accepted() == []


@pytest.mark.parametrize(
    ("port", "code", "message"),
    [
        ([], 2, "needs a port: give --port PATH"),
        (["--port", "virtual"], 2, "for a run use --backend virtual, without --port"),
        (["--port", "nowhere"], 3, "nowhere: no such port"),
        (["--port", "nowhere", "--randomise"], 2, "drop --randomise"),
        (["--port", "nowhere", "--set", "push=0.1"], 2, "push"),
    ],
)
def test_what_cannot_be_is_one_line(
    port: list[str], code: int, message: str, capsys: pytest.CaptureFixture[str]
) -> None:
    assert main([*RUN, *port, "--start"]) == code
    (line,) = capsys.readouterr().err.strip().splitlines()
    assert message in line


def test_a_rollout_on_a_real_robot_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["rollout", "walk", "--policy", "gait", "--backend", "dynamixel", "--episodes", "1"]) == 2
    assert "no truth to judge by" in capsys.readouterr().err


def test_a_frozen_controller_is_stopped_by_the_servos_and_ends_when_it_goes_on(rig: RigProcess) -> None:
    """Ctrl-Z, or a call that hangs: the guardian keeps out of it, for two would talk on one wire."""
    process = subprocess.Popen(
        [sys.executable, "-m", "servoid", *RUN[:4], "--seconds", "600", *RUN[6:], "--port", rig.port, "--start"],
        stdout=subprocess.DEVNULL,
        stderr=subprocess.DEVNULL,
        env={**os.environ, "PYTHONPATH": str(Path(__file__).resolve().parents[3] / "src")},
    )
    try:
        goals = Counter[str]()

        def moved() -> bool:
            goals.update(write["joint"] for write in rig.control.accepted() if write["register"] == "goal_position")
            return goals.total() > 10 * len(rig.control.servos())  # arming writes a few: frozen there, it never began

        until(lambda: moved() or process.poll() is not None)
        process.send_signal(signal.SIGSTOP)
        until(lambda: all(servo["tripped"] and servo["torque"] for servo in rig.control.servos()))
        process.send_signal(signal.SIGCONT)
        assert process.wait(120) == 4
        assert not any(servo["torque"] for servo in rig.control.servos())
    finally:
        process.kill()
        process.wait()

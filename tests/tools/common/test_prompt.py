"""The question before something moves or is written: only Enter or y goes on. Every verb that asks is asked here."""

from __future__ import annotations

import os
import select
import sys
import threading
from collections.abc import Callable, Iterator
from contextlib import contextmanager
from pathlib import Path

import pytest
from waiting import until

from servoid.hw.config import ConfigError
from servoid.sim.rig.process.control import RigProcess
from servoid.tools.cli import main
from servoid.tools.common.prompt import Cancelled, confirm
from servoid.tools.faults.controller import free_rig


@contextmanager
def terminal(monkeypatch: pytest.MonkeyPatch) -> Iterator[Callable[[str], None]]:
    """A terminal at standard input; yields what types into it."""
    master, slave = os.openpty()
    with os.fdopen(slave) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        yield lambda text: (os.write(master, text.encode()), None)[1]
    os.close(master)


@contextmanager
def answering(monkeypatch: pytest.MonkeyPatch, *answers: str) -> Iterator[Callable[[str], None]]:
    """A person who reads each question, and answers after it was asked; yields what types besides."""
    with terminal(monkeypatch) as type_in:
        asked, stderr = threading.Semaphore(0), sys.stderr

        class Watched:
            encoding, errors = stderr.encoding, stderr.errors

            def write(self, text: str) -> int:
                if "Press Enter to continue" in text:
                    asked.release()
                return stderr.write(text)

            def flush(self) -> None:
                stderr.flush()

            def fileno(self) -> int:
                return stderr.fileno()

        def answer() -> None:
            for text in answers:
                asked.acquire(timeout=60.0)
                type_in(text)

        monkeypatch.setattr(sys, "stderr", Watched())
        person = threading.Thread(target=answer)
        person.start()
        try:
            yield type_in
        finally:
            asked.release(len(answers))
            person.join()


@pytest.mark.parametrize("answer", ["\n", "y\n", "Y\n", "yes\n", "  \n"])
def test_enter_and_y_go_on(monkeypatch: pytest.MonkeyPatch, answer: str) -> None:
    with answering(monkeypatch, answer):
        confirm("It moves")


@pytest.mark.parametrize("answer", ["n\n", "no\n", "q\n", "yn\n", "\x1b[A\n", "ls -l\n", "0\n"])
def test_anything_else_is_a_no(monkeypatch: pytest.MonkeyPatch, answer: str) -> None:
    with answering(monkeypatch, answer), pytest.raises(Cancelled, match="neither Enter nor y"):
        confirm("It moves")


def test_what_was_typed_before_the_question_is_no_answer(monkeypatch: pytest.MonkeyPatch) -> None:
    """A robot must not walk because Enter was pressed twice at the command before."""
    with answering(monkeypatch, "n\n") as type_in:
        type_in("\n\ny\n")
        until(lambda: select.select([sys.stdin], [], [], 0.0)[0], "what was typed did not arrive")
        with pytest.raises(Cancelled, match="the answer was 'n'"):
            confirm("It moves")


def test_what_was_pasted_behind_an_answer_does_not_answer_the_next_question(monkeypatch: pytest.MonkeyPatch) -> None:
    with answering(monkeypatch, "\n\n\n", "n\n\n"):
        confirm("It moves")
        with pytest.raises(Cancelled, match="the answer was 'n'"):
            confirm("It moves")


def test_lines_that_wait_in_a_pipe_are_no_answer_either(monkeypatch: pytest.MonkeyPatch) -> None:
    read, write = os.pipe()
    os.write(write, b"\ny\n")
    os.close(write)
    with os.fdopen(read) as stdin:
        monkeypatch.setattr(sys, "stdin", stdin)
        with pytest.raises(ConfigError, match="nobody is there to press Enter: give --yes"):
            confirm("It moves")


# Every verb that asks ------------------------------------------------------------------------------------------------


@pytest.fixture(scope="module")
def shared() -> Iterator[RigProcess]:
    with free_rig() as rig:
        yield rig


@pytest.fixture
def rig(shared: RigProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> RigProcess:
    """A rig on a port, as a robot is, and a person without a calibration."""
    monkeypatch.chdir(tmp_path)
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    shared.control.reset(0)
    shared.control.accepted()
    return shared


@pytest.mark.parametrize(
    "words",
    [
        ["run", "stand", "--policy", "gait", "--backend", "dynamixel", "--port"],
        ["bringup", "jog", "l_knee", "--by", "0.1", "--port"],
        ["bringup", "calibrate", "--port"],
    ],
)
def test_a_verb_that_is_told_no_does_nothing(
    rig: RigProcess,
    tmp_path: Path,
    monkeypatch: pytest.MonkeyPatch,
    capfd: pytest.CaptureFixture[str],
    words: list[str],
) -> None:
    with answering(monkeypatch, "n\n"):
        assert main([*words, rig.port]) == 130
    said = capfd.readouterr().err
    assert said.endswith("servoid: cancelled: the answer was 'n', neither Enter nor y\n"), said
    writes = [write["register"] for write in rig.control.accepted()]
    assert not {"torque_enable", "goal_position", "id", "baud_rate", "homing_offset"} & set(writes), writes
    assert not any(servo["torque"] for servo in rig.control.servos())
    assert not list(tmp_path.rglob("*.yaml"))


def test_setup_that_is_told_no_writes_no_id(
    rig: RigProcess, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    for id in range(1, 21):
        if id != 14:
            rig.control.inject("dead", servo=id)
    with answering(monkeypatch, "n\n"):
        assert main(["bringup", "setup", "--id", "33", "--port", rig.port]) == 130
    assert "will be written: ID 14 -> 33" in capfd.readouterr().out
    assert "id" not in {write["register"] for write in rig.control.accepted()}


def test_a_calibration_that_is_told_no_at_the_end_is_not_kept(
    rig: RigProcess, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    """With hands that move the joints by themselves, the only question is the last one."""
    link = tmp_path / "rig"
    link.symlink_to(rig.port)
    link.with_name("rig.control").symlink_to(rig.control_path)
    with answering(monkeypatch, "n\n"):
        code = main(["bringup", "calibrate", "--keep-directions", "--port", str(link)])
    assert code == 130, capfd.readouterr().err
    assert not list(tmp_path.rglob("*.yaml"))

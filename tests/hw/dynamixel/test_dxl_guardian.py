"""The guardian process on a pty: silent while the controller lives, all torque off, acknowledged, when it does not."""

from __future__ import annotations

import errno
import os
import select
import signal
import subprocess
import sys
import threading
import time
import tty
from collections.abc import Callable, Iterator
from pathlib import Path
from types import SimpleNamespace

import pytest
from scripted import Memory
from waiting import until

from servoid.hw.contracts.body import BackendError
from servoid.hw.dynamixel import guardian
from servoid.hw.dynamixel.guardian_client import Lifeline
from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.codec import InstructionCode, Packet, PacketParser
from servoid.hw.dynamixel.protocol.tables import table
from servoid.hw.dynamixel.transport.port import SerialPort

IDS = (1, 2, 3, 14)
TORQUE = table("xm430-w350").item("torque_enable").address
Spoil = Callable[[int, bytes], bytes]


class Servos(threading.Thread):
    """Servos with torque on, at the far end of a pty. `spoil` makes of an answer what really comes."""

    def __init__(self) -> None:
        super().__init__(daemon=True)
        self.master, self.slave = os.openpty()
        tty.setraw(self.slave)
        self.port = os.ttyname(self.slave)
        self.memory = {id: Memory("xm430-w350", id) for id in IDS}
        for servo in self.memory.values():
            servo.put("torque_enable", 1)
        self.packets: list[Packet] = []
        self.spoil: Spoil = lambda id, answer: answer
        self.delay = 0.0
        self.deaf = 0  # writes of torque that nobody hears
        self.babble = b""
        self.over = False
        self.start()

    def run(self) -> None:
        parser = PacketParser()
        while not self.over:
            if self.babble:
                os.write(self.master, self.babble)
            if select.select([self.master], [], [], 0.001 if self.babble else 0.05)[0]:
                for packet in parser.feed(os.read(self.master, 4096)):
                    self.packets.append(packet)
                    self.answer(packet)

    def answer(self, packet: Packet) -> None:
        p = packet.params
        word = int.from_bytes(p[:2], "little")
        length = int.from_bytes(p[2:4], "little")
        if packet.instruction == InstructionCode.SYNC_WRITE:
            if word == TORQUE and self.deaf:
                self.deaf -= 1
                return
            for at in range(4, len(p), 1 + length):
                self.memory[p[at]].write(word, p[at + 1 : at + 1 + length])
        elif packet.instruction in (InstructionCode.SYNC_READ, InstructionCode.READ):
            for id in p[4:] if packet.instruction == InstructionCode.SYNC_READ else (packet.id,):
                servo = self.memory[id]
                status = codec.status(id, servo.alert, bytes(servo.bytes[word : word + length]))
                time.sleep(self.delay)
                os.write(self.master, self.spoil(id, status))

    def writes(self, name: str) -> list[int]:
        return [value for servo in self.memory.values() for register, value in servo.writes if register == name]

    def torque(self) -> list[int]:
        return [servo.get("torque_enable") for servo in self.memory.values()]

    def end(self) -> None:
        self.over = True
        self.join()
        os.close(self.master)
        os.close(self.slave)


@pytest.fixture
def servos() -> Iterator[Servos]:
    servos = Servos()
    yield servos
    if not servos.over:
        servos.end()


@pytest.fixture
def line(servos: Servos, tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> Iterator[Lifeline]:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    port = SerialPort(servos.port, 2_000_000)
    line = Lifeline(port, IDS, table("xm430-w350"), 0.0)
    yield line
    line.close()
    port.close()


def told(tmp_path: Path) -> str:
    return (tmp_path / "servoid" / "guardian.log").read_text()


def test_a_pipe_that_closes_with_torque_on_damps_and_then_lets_go(
    servos: Servos, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    port = SerialPort(servos.port, 2_000_000)
    line = Lifeline(port, IDS, table("xm430-w350"), 0.0)
    line.hold()
    assert line.close()  # for the guardian the same as a kill: nothing said that torque is off
    port.close()
    assert servos.torque() == [0] * len(IDS)
    for servo in servos.memory.values():
        names = [name for name, value in servo.writes if value == 0]
        assert names[:3] == ["position_d_gain", "position_i_gain", "position_p_gain"]
        assert names.index("torque_enable") > names.index("position_p_gain")
    said = capfd.readouterr().err
    assert f"process {os.getpid()} ended with torque on: 4 of 4 servos damped, then torque off, acknowledged" in said
    assert len(said.splitlines()) == 1
    assert said.strip() in told(tmp_path)


def test_while_the_controller_lives_nothing_is_sent_whatever_signals_come(servos: Servos, line: Lifeline) -> None:
    line.hold()
    for number in (signal.SIGINT, signal.SIGTERM, signal.SIGHUP):
        os.kill(line.pid, number)
    time.sleep(0.2)
    line.check()
    assert servos.packets == []
    assert os.getpgid(line.pid) != os.getpgid(0), "Ctrl-C in the terminal is for the controller's group"
    assert servos.torque() == [1] * len(IDS)


def test_a_clean_end_sends_nothing_and_leaves_nothing(servos: Servos, line: Lifeline, tmp_path: Path) -> None:
    line.hold()
    line.let_go()
    pid = line.pid
    assert not line.close()
    assert not Path(f"/proc/{pid}").exists()
    assert servos.packets == []
    assert not (tmp_path / "servoid").exists()


def test_torque_that_was_never_on_is_not_switched(servos: Servos, line: Lifeline) -> None:
    line.close()
    assert servos.packets == []


def nothing_at_first(count: int) -> Spoil:
    left = dict.fromkeys(IDS, count)

    def spoil(id: int, answer: bytes) -> bytes:
        left[id] -= 1
        return b"" if left[id] >= 0 else answer

    return spoil


@pytest.mark.parametrize(
    ("spoil", "delay", "babble"),
    [
        (nothing_at_first(3), 0.0, b""),
        (lambda id, answer: answer, 0.025, b""),  # each later than it is waited for
        (lambda id, answer: b"\xff\xff\xfd\x00" + answer, 0.0, b""),
        (lambda id, answer: answer, 0.0, b"\xff\xff\xfd\x00\x01\x55"),  # the line is never silent
    ],
    ids=["lost", "late", "garbled", "babbling"],
)
def test_a_bad_line_is_insisted_on(
    servos: Servos, line: Lifeline, tmp_path: Path, spoil: Spoil, delay: float, babble: bytes
) -> None:
    """One that loses the first torque off, too: whoever does not insist leaves the robot stiff."""
    line.hold()
    servos.spoil, servos.delay, servos.babble, servos.deaf = spoil, delay, babble, 1
    line.close()
    assert servos.torque() == [0] * len(IDS)
    assert "4 of 4" in told(tmp_path)


def test_an_alert_and_a_lit_led_do_not_hide_an_acknowledgement(servos: Servos, line: Lifeline, tmp_path: Path) -> None:
    line.hold()
    servos.memory[2].put("hardware_error_status", 32)
    servos.memory[3].put("led", 1)
    line.close()
    assert "4 of 4" in told(tmp_path)


@pytest.mark.slow
def test_only_the_answer_about_torque_counts(servos: Servos, line: Lifeline, tmp_path: Path) -> None:
    """A servo that keeps its torque on, or whose late answer to another question comes by, has not let go."""
    line.hold()
    on = codec.status(14, 0, b"\1\0")
    servos.spoil = lambda id, answer: on + codec.status(14, 0, b"\0") + codec.status(14) if id == 14 else answer
    assert not line.close()
    said = told(tmp_path)
    assert "3 of 4 servos damped and off, no word from ID 14: hold the robot" in said
    assert len(servos.writes("torque_enable")) > 4 * 10, "it is asked again and again"


def test_a_port_that_is_gone_too_is_said(servos: Servos, line: Lifeline, tmp_path: Path) -> None:
    line.hold()
    servos.end()
    assert not line.close()
    assert "cannot be reached either" in told(tmp_path)


def test_a_guardian_that_is_killed_is_replaced_and_told_again(servos: Servos, line: Lifeline) -> None:
    line.hold()
    first = line.pid
    os.kill(first, signal.SIGKILL)
    until(lambda: line.check() or line.pid != first)  # type: ignore[func-returns-value]
    line.close()
    assert servos.torque() == [0] * len(IDS)


def test_a_guardian_that_cannot_live_keeps_torque_off(line: Lifeline, monkeypatch: pytest.MonkeyPatch) -> None:
    os.kill(line.pid, signal.SIGKILL)
    line._process.wait(60.0)
    monkeypatch.setattr(guardian, "__file__", "/nonexistent/guardian.py")
    with pytest.raises(BackendError, match="torque stays off"):
        line.hold()


def test_a_guardian_that_cannot_be_replaced_does_not_keep_torque_on(
    line: Lifeline, monkeypatch: pytest.MonkeyPatch
) -> None:
    """Out of processes or file descriptors in the middle of a run: a clear error, and then torque off as ever."""
    line.hold()
    os.kill(line.pid, signal.SIGKILL)
    line._process.wait(60.0)

    def full(*_: object, **__: object) -> None:
        raise OSError(errno.EAGAIN, "Resource temporarily unavailable")

    monkeypatch.setattr(subprocess, "Popen", full)
    with pytest.raises(BackendError, match="the guardian process cannot be started"):
        line.check()
    line.let_go()
    line.close()


CONTROLLER = """
import os, sys, time
from servoid.hw.dynamixel.guardian_client import Lifeline
from servoid.hw.dynamixel.transport.port import SerialPort
from servoid.hw.dynamixel.protocol.tables import table
line = Lifeline(SerialPort(sys.argv[1], 2_000_000), (1, 2, 3, 14), table("xm430-w350"), 0.0)
line.hold()
if os.fork() == 0:  # a child that keeps everything open, the pipe among it
    os.close(1)
    time.sleep(30)
print(os.getpid(), flush=True)
time.sleep(30)
"""


def test_the_controllers_death_is_seen_even_if_a_child_of_it_keeps_the_pipe_open(
    servos: Servos, tmp_path: Path, monkeypatch: pytest.MonkeyPatch
) -> None:
    monkeypatch.setenv("XDG_STATE_HOME", str(tmp_path))
    process = subprocess.Popen(
        [sys.executable, "-c", CONTROLLER, servos.port],
        stdout=subprocess.PIPE,
        start_new_session=True,
        cwd=Path(__file__).resolve().parents[3],
    )
    try:
        assert process.stdout is not None
        os.kill(int(process.stdout.readline()), signal.SIGKILL)
        until(lambda: servos.torque() == [0] * len(IDS))
    finally:
        os.killpg(process.pid, signal.SIGKILL)
        process.communicate()


def test_it_needs_nothing_but_the_standard_library() -> None:
    code = (
        f"import sys, runpy; runpy.run_path({guardian.__file__!r}); print('numpy' in sys.modules, 'hw' in sys.modules)"
    )
    result = subprocess.run(
        [sys.executable, "-I", "-S", "-c", code], capture_output=True, text=True, check=True, cwd="/"
    )
    assert result.stdout.split() == ["False", "False"]


def test_servos_are_braked_for_a_while_before_torque_goes_off(monkeypatch: pytest.MonkeyPatch) -> None:
    """Torque that went off at once would let the robot drop. In a time that passes only while the port is read."""
    passed = [0.0]
    sent: list[tuple[float, bytes]] = []

    class Port:
        def __init__(self, fd: int) -> None: ...

        def drain(self) -> None: ...

        def write(self, data: bytes) -> None:
            sent.append((passed[0], data))

        def read(self, seconds: float) -> bytes:
            passed[0] += seconds + 1e-6
            return b""

    monkeypatch.setattr(guardian, "GuardedPort", Port)
    monkeypatch.setattr(guardian, "time", SimpleNamespace(monotonic=lambda: passed[0]))
    plan = guardian.ReleasePackets(0, "port", 1, b"damp", b"off", b"", 0.0, {}, {}, "")
    assert guardian.release(plan) == set()
    braked = next(place for place, data in sent if data == b"damp")
    released = next(place for place, data in sent if data.startswith(b"off"))
    assert released - braked >= guardian.DAMP_SECONDS

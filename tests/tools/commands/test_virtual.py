"""`servoid virtual`, and `run` and `rollout` with `--backend virtual`, as a person starts them."""

from __future__ import annotations

import json
import os
import signal
import socket
import subprocess
import sys
import time
from pathlib import Path

import pytest
import serial
from waiting import until

from servoid.hw.config import ConfigError
from servoid.hw.dynamixel.protocol import codec
from servoid.hw.robot.description import load_robot
from servoid.sim.rig.process.control import RigProcess
from servoid.sim.rig.process.pty import Pty
from servoid.sim.rig.process.server import Server
from servoid.sim.rig.rig import Rig
from servoid.stack.log.flightlog import read_log
from servoid.tools.cli import main
from servoid.tools.commands.run import tell_lateness
from servoid.tools.common.output import reporting

RUN = ["run", "walk", "--policy", "gait", "--backend", "virtual"]


@pytest.fixture(autouse=True)
def elsewhere(tmp_path: Path, monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.chdir(tmp_path)


def start(*arguments: str) -> subprocess.Popen[str]:
    return subprocess.Popen(
        [sys.executable, "-m", "servoid", *arguments], stdout=subprocess.PIPE, stderr=subprocess.PIPE, text=True
    )


def walks(path: Path) -> bool:
    """Whether a run that is being recorded has begun its task, by its log so far."""
    try:
        commands = read_log(path).messages["/command"]
    except ConfigError:  # its header is not there yet
        return False
    return bool(commands) and commands[-1]["phase"] == "running"


@pytest.mark.slow
def test_the_verb_serves_a_port_until_ctrl_c(tmp_path: Path) -> None:
    """Any program can talk to it: the board answers a ping on the link, and both are gone afterwards."""
    process = start("virtual", "--link", "rig", "--json")
    assert process.stdout is not None
    told = json.loads(process.stdout.readline())
    assert told["robot"] == "op3"
    assert told["port"] in ("rig", os.path.realpath("rig"))
    with serial.Serial("rig", told["baud"], timeout=0.2) as port:

        def answers() -> bool:
            port.write(codec.ping(200))
            return port.read(14)[:5] == b"\xff\xff\xfd\x00\xc8"

        until(answers)
    process.send_signal(signal.SIGINT)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 0, err
    assert out == ""
    assert not list(tmp_path.iterdir()), "link and socket are taken away"


@pytest.mark.parametrize("link", ["", ".", "/", ".."])
def test_a_link_that_is_no_name_is_refused(link: str, capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["virtual", "--link", link]) == 2
    assert "--link" in capsys.readouterr().err


def test_what_another_program_has_linked_is_neither_replaced_nor_deleted(
    tmp_path: Path, capsys: pytest.CaptureFixture[str]
) -> None:
    (tmp_path / "notes").write_text("mine")
    (tmp_path / "rig").symlink_to("notes")
    assert main(["virtual", "--link", "rig"]) == 2
    assert "rig is there already, and no virtual rig made it" in capsys.readouterr().err
    assert (tmp_path / "rig").read_text() == "mine"
    assert sorted(path.name for path in tmp_path.iterdir()) == ["notes", "rig"]


def test_a_link_that_points_to_nothing_or_that_a_killed_rig_left_is_replaced(tmp_path: Path) -> None:
    link = tmp_path / "rig"
    link.symlink_to("nothing")
    first = Pty(link)
    with socket.socket(socket.AF_UNIX) as control:
        control.bind(str(tmp_path / "rig.control"))  # of a rig that was killed: nobody listens
    server = Server(Rig(load_robot()), link=link, control=tmp_path / "rig.control")
    assert os.readlink(link) == server.pty.name != first.name
    first.close()
    assert os.readlink(link) == server.pty.name, "it is another rig's by now"
    link.unlink()
    link.symlink_to("/dev/null")
    server.close()
    assert os.readlink(link) == "/dev/null"


@pytest.mark.slow
@pytest.mark.parametrize(
    ("options", "silent_board", "says"),
    [
        ((), False, "writes 1 to register 24 of the board, ID 200"),
        (("--powered",), False, "The servos have power already."),
        (("--no-board", "--baud", "1000000"), True, "There is no board: the servos have power."),
    ],
)
def test_what_a_client_must_do_is_said_and_is_all_that_it_must_do(
    options: tuple[str, ...], silent_board: bool, says: str
) -> None:
    process = start("virtual", "--link", "rig", "--json", *options)
    assert process.stdout is not None
    told = json.loads(process.stdout.readline())
    assert told["board_id"] == (None if silent_board else 200)
    with serial.Serial("rig", told["baud"], timeout=0.5) as port:

        def asked(packet: bytes) -> int:
            """How many bytes are answered; a busy machine may take its time."""
            for _ in range(20 if told["powered"] else 2):
                port.write(packet)
                if answer := port.read(14):
                    return len(answer)
            return 0

        assert bool(asked(codec.ping(1))) is told["powered"]
        assert bool(asked(codec.ping(200))) is not silent_board
    process.send_signal(signal.SIGINT)
    _, err = process.communicate(timeout=120)
    assert says in err
    assert "--move JOINT=RAD" in err


@pytest.mark.slow
def test_joints_of_a_limp_virtual_robot_are_moved_by_a_command(capsys: pytest.CaptureFixture[str]) -> None:
    """Another program records a range meanwhile: it sees the joint on its way, through the servo's own register."""
    process = start("virtual", "--link", "rig", "--powered", "--json")
    assert process.stdout is not None
    baud = json.loads(process.stdout.readline())["baud"]
    hand = start("virtual", "--link", "rig", "--move", "head_pan=1.0", "--over", "1", "--json")
    seen: list[int] = []
    with serial.Serial("rig", baud, timeout=0.05) as port:
        there = 0  # answers since the hand let go: the last of them is where it is left
        while there < 3:
            there += hand.poll() is not None
            port.write(codec.read(19, 132, 4))
            answer = port.read(15)
            if len(answer) == 15:
                seen.append(int.from_bytes(answer[9:13], "little", signed=True))
            else:
                there = 0
        port.write(codec.write(19, 64, b"\1"))
        port.read(11)
    assert json.loads(hand.communicate()[0]) == {"joints": {"head_pan": 1.0}}
    assert abs(seen[-1] - (2048 + 652)) <= 3, "652 ticks to a radian, from the centre"
    assert len({tick for tick in seen if min(seen) + 50 < tick < max(seen) - 50}) > 2, "it did not jump"
    assert main(["virtual", "--link", "rig", "--move", "head_pan=0"]) == 3
    assert "head_pan: the servo has torque and cannot be moved by hand" in capsys.readouterr().err
    assert main(["virtual", "--link", "rig", "--move", "head_pam=0"]) == 3
    assert "did you mean 'head_pan'" in capsys.readouterr().err
    for words in (["--move", "head_pan=x", "--link", "rig"], ["--move", "head_pan=1"]):
        assert main(["virtual", *words]) == 2
    process.send_signal(signal.SIGINT)
    process.communicate(timeout=120)


def test_a_run_says_that_it_was_the_rig_that_was_late(tmp_path: Path, capsys: pytest.CaptureFixture[str]) -> None:
    """On a busy machine the driver would blame cable and latency timer. Here the rig is held up for a moment."""
    with RigProcess(clock="real") as rig, reporting(False) as report:
        (tmp_path / "rig.control").symlink_to(rig.control_path)
        tell_lateness(report, str(tmp_path / "rig"))  # what was late while it started is told by now
        os.kill(rig.process.pid, signal.SIGSTOP)
        time.sleep(0.1)
        os.kill(rig.process.pid, signal.SIGCONT)
        capsys.readouterr()
        tell_lateness(report, str(tmp_path / "rig"))
        tell_lateness(report, "/dev/ttyUSB0")
        report.result({})
    (line,) = capsys.readouterr().out.splitlines()
    assert line.startswith("the virtual rig was late")
    assert "say nothing about cable, adapter or latency timer" in line


def test_a_locked_rig_that_nobody_could_advance_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["virtual", "--clock", "locked"]) == 2
    assert "use --link or --control" in capsys.readouterr().err


@pytest.mark.slow
def test_a_run_is_recorded_and_replays_bit_for_bit(capfd: pytest.CaptureFixture[str]) -> None:
    options = ["--seconds", "2", "--set", "push=0.05", "--randomise", "--seed", "3", "--set", "vx=0.1"]
    assert main([*RUN, *options, "--record", "a.mcap", "--json"]) == 0
    values = json.loads(capfd.readouterr().out)
    assert (values["backend"], values["outcome"], values["missed"]) == ("virtual", "succeeded", 0)
    log = read_log("a.mcap")
    assert log.messages["/command"][-1]["mode"] == "OFF"
    assert log.messages["/command"][-1]["phase"] == "damped"
    assert main(["replay", "a.mcap"]) == 0, capfd.readouterr().out


@pytest.mark.slow
def test_a_robot_of_ones_own_file_is_emulated(capfd: pytest.CaptureFixture[str], tmp_path: Path) -> None:
    """The servo's ID is another than the shipped robot's: the rig must be that of the file."""
    from servoid.hw.robot.description import load_robot, save_robot

    save_robot(load_robot(), tmp_path / "mine.yaml")
    text = (tmp_path / "mine.yaml").read_text()
    assert text.count("id: 19\n") == 1
    (tmp_path / "mine.yaml").write_text(text.replace("id: 19\n", "id: 77\n"))
    assert main([*RUN, "--robot", "mine.yaml", "--seconds", "0.5"]) == 0, capfd.readouterr().err


@pytest.mark.slow
def test_rollouts_are_the_same_on_one_and_two_workers(capfd: pytest.CaptureFixture[str]) -> None:
    words = ["rollout", "walk", "--policy", "expert", "--backend", "virtual", "--seconds", "2", "--episodes", "2"]
    figures = []
    for workers in ("1", "2"):
        assert main([*words, "--workers", workers, "--json"]) == 0
        figures.append(json.loads(capfd.readouterr().out))
        assert figures[-1].pop("wall_seconds") > 0
    assert figures[0] == figures[1]
    assert figures[0]["backend"] == "virtual"
    assert figures[0]["metrics"]["odometry_error_m"] < 0.1


def test_a_port_for_the_virtual_rig_is_refused(capsys: pytest.CaptureFixture[str]) -> None:
    assert main([*RUN, "--port", "/dev/ttyUSB0"]) == 2
    assert "drop --port" in capsys.readouterr().err


@pytest.mark.slow
@pytest.mark.parametrize("number", [signal.SIGINT, signal.SIGTERM])
def test_a_signal_in_mid_walk_ends_with_torque_off_acknowledged(number: signal.Signals, tmp_path: Path) -> None:
    """A servo that had not said that torque is off would be exit code 3."""
    process = start(*RUN, "--seconds", "600", "--record", "a.mcap", "--json")
    until(lambda: walks(tmp_path / "a.mcap") or process.poll() is not None, "it does not walk")
    process.send_signal(number)
    out, err = process.communicate(timeout=120)
    assert process.returncode == 130, err
    assert json.loads(out)["outcome"] == "interrupted"
    log = read_log("a.mcap")
    assert log.complete
    assert log.messages["/command"][-1]["mode"] == "OFF"

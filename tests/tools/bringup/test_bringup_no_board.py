"""A robot without a board, its servos on a U2D2 with a supply of their own: bring-up and runs on the virtual rig."""

from __future__ import annotations

import json
import subprocess
import sys
from collections.abc import Iterator
from pathlib import Path

import pytest

from servoid.hw.config import CONFIGS, ConfigError
from servoid.hw.robot.description import load_robot
from servoid.tools.cli import main


def without_board(folder: Path, imu: str) -> Path:
    text = (CONFIGS / "robots" / "op3.yaml").read_text()
    text = text.replace("mjcf: op3.xml", f"mjcf: {CONFIGS / 'robots' / 'op3.xml'}")
    text = text.replace("  board_id: 200 ", "  board: none ").replace("  kind: opencr ", f"  kind: {imu} ")
    path = folder / f"{imu.split()[0]}.yaml"
    path.write_text(text.replace("signs: [-1, -1, 1]", "signs: [1, 1, 1]"))
    return path


@pytest.fixture(scope="module")
def robot(tmp_path_factory: pytest.TempPathFactory) -> Path:
    return without_board(tmp_path_factory.mktemp("robot"), "none")


@pytest.fixture(scope="module")
def port(robot: Path) -> Iterator[str]:
    command = [sys.executable, "-m", "servoid.sim.rig.process.server", "--robot", str(robot), "--linger", "60"]
    with subprocess.Popen(command, stdout=subprocess.PIPE, text=True) as server:
        assert server.stdout is not None
        yield json.loads(server.stdout.readline())["port"]
        server.terminate()


def test_a_boards_imu_needs_a_board(tmp_path: Path) -> None:
    with pytest.raises(ConfigError, match=r"imu.kind: the board's IMU, but bus.board is none: name another kind"):
        load_robot(without_board(tmp_path, "opencr"))


def test_a_virtual_rig_has_the_imu_that_would_be_on_a_port_of_its_own(capsys: pytest.CaptureFixture[str]) -> None:
    """It was said to send nothing, and its cable to be looked at."""
    assert main(["bringup", "watch", "--port", "virtual", "--robot", "wren", "--seconds", "0.2"]) == 0
    said = capsys.readouterr().out
    assert "IMU: force" in said
    assert "cable" not in said


@pytest.mark.parametrize("verb", [["scan", "--baud", "2000000"], ["check"], ["off"], ["watch", "--seconds", "0.2"]])
def test_bring_up_asks_no_board(
    robot: Path, verb: list[str], tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    code = main(["bringup", *verb, "--port", "virtual", "--robot", str(robot), "--json"])
    out, err = capfd.readouterr()
    assert code == 0, err
    found = json.loads(out)
    assert "the board answer" not in err
    if verb[0] == "scan":
        assert len(found["devices"]) == 20
        assert "op3 has no board: its servos have a supply of their own" in err


@pytest.mark.slow
@pytest.mark.parametrize("imu", ["none", "bno08x"])
def test_it_runs_on_the_virtual_rig(tmp_path: Path, imu: str, capfd: pytest.CaptureFixture[str]) -> None:
    """Without an IMU it stands; a virtual rig lends a board for the one that a file names on a serial port."""
    text = imu if imu == "none" else f"{imu}\n  port: /dev/nothing"
    words = ["--policy", "gait", "--robot", str(without_board(tmp_path, text)), "--seconds", "1", "--json"]
    words += ["--record", str(tmp_path / "run.mcap")]
    code = main(["run", "stand", "--backend", "virtual", *words])
    out, err = capfd.readouterr()
    assert code == 0, err
    assert json.loads(out)["outcome"] == "succeeded"


@pytest.mark.slow
def test_it_runs_as_hardware(
    port: str, robot: Path, tmp_path: Path, monkeypatch: pytest.MonkeyPatch, capfd: pytest.CaptureFixture[str]
) -> None:
    monkeypatch.setenv("XDG_CONFIG_HOME", str(tmp_path))
    words = ["--policy", "gait", "--robot", str(robot), "--seconds", "1"]
    for i in range(5):
        log = ["--record", str(tmp_path / f"{i}.mcap")]
        code = main(["run", "stand", "--backend", "dynamixel", "--port", port, "--start", *words, *log])
        if code not in (3, 4):  # a busy machine's rig did not answer in time, or its samples came late
            break
    assert code == 0, capfd.readouterr().err

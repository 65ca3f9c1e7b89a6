"""`servoid bringup find-port`: adapters that come and go while a person looks for the right one."""

from __future__ import annotations

import os
from pathlib import Path
from types import SimpleNamespace
from typing import Any

import pytest

from servoid.tools.bringup import find_port, ports
from servoid.tools.cli import main

U2D2 = SimpleNamespace(device="/dev/ttyUSB0", vid=0x0403, pid=0x6014, description="USB <-> Serial Converter")
OTHER = SimpleNamespace(device="/dev/ttyUSB1", vid=0x10C4, pid=0xEA60, description="CP2102")
BOARD = SimpleNamespace(device="/dev/ttyS0", vid=None, pid=None, description="ttyS0")


@pytest.fixture
def plugged(monkeypatch: pytest.MonkeyPatch) -> list[list[SimpleNamespace]]:
    """What is plugged in at each look; the last entry stays."""
    states = [[BOARD]]
    monkeypatch.setattr(ports.list_ports, "comports", lambda: states.pop(0) if len(states) > 1 else states[0])
    monkeypatch.setattr(find_port, "_POLL", 0.0)
    return states


@pytest.mark.parametrize(
    ("states", "what", "path"),
    [
        ([[BOARD, OTHER], [BOARD, OTHER], [BOARD, OTHER, U2D2]], "plugged in", "/dev/ttyUSB0"),
        ([[BOARD, OTHER, U2D2], [BOARD, U2D2]], "unplugged", "/dev/ttyUSB1"),
        ([[BOARD, OTHER, U2D2], [BOARD, U2D2], [BOARD, U2D2], [BOARD, OTHER, U2D2]], "plugged in", "/dev/ttyUSB1"),
        ([[BOARD, U2D2], [BOARD], [BOARD, OTHER]], "plugged in", "/dev/ttyUSB1"),  # the kernel names it anew
        (
            [[BOARD, OTHER, U2D2], [BOARD, OTHER], [BOARD], [BOARD, OTHER], [BOARD, OTHER, U2D2]],  # a whole hub
            "plugged in",
            "/dev/ttyUSB0",
        ),
    ],
)
def test_the_adapter_that_came_or_went_is_the_one(
    plugged: list[list[SimpleNamespace]], bringup: Any, states: list[list[SimpleNamespace]], what: str, path: str
) -> None:
    plugged[:] = states
    code, answer, err = bringup("find-port", "--wait", "1")
    assert code == 0
    assert [port["path"] for port in answer["ports"]] == sorted(p.device for p in states[0] if p is not BOARD)
    assert (answer["changed"]["how"], answer["changed"]["path"]) == (what, path)
    assert f"servoid bringup scan --port {path}" in err
    went = len(states[1]) < len(states[0])
    assert ("Plug it in again" in err) is went, "a port that was unplugged cannot be scanned"
    assert ("still unplugged" in err) is (what == "unplugged")


def test_a_change_that_does_not_come_is_said_and_no_error(plugged: list[list[SimpleNamespace]], bringup: Any) -> None:
    plugged[:] = [[U2D2]]
    code, answer, err = bringup("find-port", "--wait", "0.1")
    assert (code, answer["changed"]) == (0, None)
    assert "ROBOTIS U2D2" in err
    assert "nothing changed" in err


def test_a_port_that_is_not_there_is_an_error(plugged: list[list[SimpleNamespace]], bringup: Any) -> None:
    code, answer, _ = bringup("find-port", "--port", "/dev/ttyUSB7")
    assert code == 3
    assert "plug it in" in answer["error"]


def test_a_port_may_be_given_by_the_name_that_stays(
    plugged: list[list[SimpleNamespace]], bringup: Any, tmp_path: Path
) -> None:
    plugged[:] = [[U2D2]]
    link = tmp_path / "usb-ROBOTIS_U2D2"
    link.symlink_to(U2D2.device)
    code, answer, _ = bringup("find-port", "--port", str(link))
    assert code == 0, answer
    assert [port["path"] for port in answer["ports"]] == ["/dev/ttyUSB0"]


def test_verbs_without_a_port_say_which_are_there(plugged: list[list[SimpleNamespace]], bringup: Any) -> None:
    plugged[:] = [[U2D2, OTHER]]
    code, answer, _ = bringup("watch")
    assert code == 2
    assert "USB ports here: /dev/ttyUSB0, /dev/ttyUSB1" in answer["error"]


def test_the_name_that_stays_is_the_link_to_this_adapter(tmp_path: Path) -> None:
    for name in ("ttyUSB0", "ttyUSB1"):
        (tmp_path / name).write_text("")
        os.symlink(tmp_path / name, tmp_path / f"by-id-of-{name}")
    (tmp_path / "by-id").mkdir()
    (tmp_path / "by-id" / "usb-U2D2").symlink_to(tmp_path / "ttyUSB1")
    assert ports._lasting(str(tmp_path / "ttyUSB1"), tmp_path / "by-id") == str(tmp_path / "by-id" / "usb-U2D2")
    assert ports._lasting(str(tmp_path / "ttyUSB0"), tmp_path / "by-id") == str(tmp_path / "ttyUSB0")


def test_help_is_quick_and_names_every_verb(capsys: pytest.CaptureFixture[str]) -> None:
    assert main(["bringup", "--help"]) == 0
    out = capsys.readouterr().out
    for verb in ("find-port", "scan", "setup", "check", "calibrate", "jog", "watch"):
        assert f"  {verb} " in out

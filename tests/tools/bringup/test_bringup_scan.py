"""`servoid bringup scan`, `setup` and `check` on a virtual rig, and the mistakes that people make."""

from __future__ import annotations

import os
from collections.abc import Iterator
from contextlib import contextmanager
from pathlib import Path
from typing import Any

import pytest

from servoid.hw.dynamixel.protocol.tables import table
from servoid.hw.dynamixel.servos.bus_scan import power_on
from servoid.hw.dynamixel.transport.bus import Bus
from servoid.hw.dynamixel.transport.port import SerialPort
from servoid.hw.robot.description import load_robot
from servoid.sim.rig.process.control import LockedClock, RigProcess
from servoid.sim.rig.servo.factory_state import FactoryState

ROBOT = load_robot()
XM430 = table("xm430-w350")
KNEE = 14
VIRTUAL = ("--port", "virtual")
AT_2M = (*VIRTUAL, "--baud", "2000000")


@contextmanager
def bus_of(rig: RigProcess) -> Iterator[Bus]:
    """The rig's bus, its servos with power."""
    port = SerialPort(rig.port, ROBOT.bus.baud)
    try:
        bus = Bus(port, LockedClock(rig.control))
        power_on(bus, ROBOT.bus.board_id, [ROBOT.bus.baud])
        yield bus
    finally:
        port.close()


def write(rig: RigProcess, id: int, /, **registers: int) -> None:
    with bus_of(rig) as bus:
        for name, value in registers.items():
            assert bus.write_item(id, XM430.item(name), value), name


def test_a_scan_lists_everybody_with_what_they_measure(rig: RigProcess, bringup: Any) -> None:
    code, found, err = bringup("scan", *VIRTUAL)
    assert code == 0
    assert found["problems"] == found["missing"] == []
    servos = {device["joint"]: device for device in found["devices"] if device["model"] != "opencr"}
    assert {name: device["id"] for name, device in servos.items()} == {j.name: j.id for j in ROBOT.joints}
    knee = servos["l_knee"]
    assert (knee["baud"], knee["model"], knee["firmware"], knee["torque"], knee["errors"]) == (
        *(2000000, "xm430-w350", 52, False, []),
    )
    assert 11.5 < knee["voltage"] < 12.5
    assert 20 <= knee["temperature"] <= 30
    assert len(found["bauds"]) == 8
    assert "l_knee" in err


@pytest.mark.parametrize(
    ("fault", "words"),
    [
        (
            {"kind": "id_conflict", "servo": "l_hip_yaw"},
            "ID 8 at 2000000 bit/s answers garbled, however often it is asked: two",
        ),
        ({"kind": "overheating", "servo": "l_knee"}, "ID 14, 2000000 bit/s: reports overheating: let it cool"),
    ],
)
def test_a_scan_names_what_must_be_mended(rig: RigProcess, bringup: Any, fault: dict[str, Any], words: str) -> None:
    with bus_of(rig):  # a servo that gets its power afterwards would have forgotten an error
        rig.control.inject(**fault)
    code, found, err = bringup("scan", *AT_2M)
    assert code == 3
    assert any(words in text for text in found["problems"]), found["problems"]
    assert words in err


def test_a_servo_at_another_baud_is_found_there_and_missed_here(rig: RigProcess, bringup: Any) -> None:
    rig.control.inject("baud_mismatch", servo="l_knee")
    code, found, _ = bringup("scan", *VIRTUAL)
    assert code == 3
    assert found["missing"] == ["l_knee (ID 14)"]
    (stray,) = [device for device in found["devices"] if device["baud"] != 2000000]
    assert (stray["id"], stray["joint"]) == (KNEE, None)
    assert f"servoid bringup setup l_knee --from 14 --from-baud {stray['baud']}" in found["problems"][0]


def test_a_board_without_servos_and_a_line_without_anybody(rig: RigProcess, bringup: Any) -> None:
    for joint in ROBOT.joints:
        rig.control.inject("dead", servo=joint.name)
    code, found, _ = bringup("scan", *AT_2M)
    assert code == 3
    assert "no servo does" in found["problems"][0]
    master, slave = os.openpty()
    try:
        code, answer, _ = bringup("scan", "--port", os.ttyname(slave), "--baud", "2000000")
    finally:
        os.close(master)
        os.close(slave)
    assert code == 3
    assert "no answer at 2000000 bit/s: is the supply on" in answer["error"]


def test_ports_that_cannot_be_opened(rig: RigProcess, bringup: Any, tmp_path: Path) -> None:
    code, answer, _ = bringup("scan", "--port", str(tmp_path / "ttyUSB9"))
    assert (code, "no such port" in answer["error"]) == (3, True)
    code, answer, _ = bringup("check")
    assert code == 2
    assert "practise with --port virtual" in answer["error"]
    with bus_of(rig):
        code, answer, _ = bringup("check", "--port", rig.port)
    assert code == 3
    assert "another program has the port" in answer["error"]


# Setup ---------------------------------------------------------------------------------------------------------------


def test_more_than_one_servo_is_refused(rig: RigProcess, bringup: Any) -> None:
    code, answer, _ = bringup("setup", "l_knee", *VIRTUAL, "--yes")
    assert code == 3
    assert "20 servos answer" in answer["error"]
    assert "unplug all but the one" in answer["error"]


def alone(rig: RigProcess, name: str) -> None:
    for joint in ROBOT.joints:
        if joint.name != name:
            rig.control.inject("dead", servo=joint.name)
    with bus_of(rig) as bus:  # time for them to die
        bus.clock.sleep_until(bus.clock.now_ns() + 50_000_000)


def test_torque_is_refused_and_a_used_servo_gets_another_id(rig: RigProcess, bringup: Any) -> None:
    alone(rig, "l_knee")
    write(rig, KNEE, torque_enable=1)
    code, answer, _ = bringup("setup", "--id", "33", *VIRTUAL, "--yes")
    assert code == 3
    assert "has torque on, which locks its EEPROM" in answer["error"]
    write(rig, KNEE, torque_enable=0)
    code, answer, _ = bringup("setup", "--id", "33", "--baud", "1000000", *VIRTUAL, "--yes")
    assert code == 0, answer
    assert (answer["before"], answer["after"]) == ({"id": 14, "baud": 2000000}, {"id": 33, "baud": 1000000})
    code, answer, _ = bringup("setup", "l_knee", *VIRTUAL, "--yes")
    assert (code, answer["after"], answer["written"]) == (0, {"id": 14, "baud": 2000000}, True)
    code, answer, _ = bringup("setup", "l_knee", *VIRTUAL)
    assert (code, answer["written"]) == (0, False), "what is right is not written, nor asked about"


def test_nothing_is_written_without_a_yes(
    rig: RigProcess, bringup: Any, monkeypatch: pytest.MonkeyPatch, tmp_path: Path
) -> None:
    alone(rig, "l_knee")
    (tmp_path / "nobody").write_text("")
    with (tmp_path / "nobody").open() as nobody:
        monkeypatch.setattr("sys.stdin", nobody)
        code, answer, err = bringup("setup", "--id", "33", *VIRTUAL)
    assert code == 2
    assert "will be written: ID 14 -> 33" in err
    assert "give --yes" in answer["error"]
    with bus_of(rig) as bus:
        assert bus.ping(KNEE) is not None
        assert bus.ping(33) is None


@pytest.mark.parametrize(
    ("words", "said"),
    [
        (("--id", "253"), "servo IDs are 0..252"),
        (("--id", "200"), "that is the board's"),
        (("--id", "5", "--baud", "128000"), "Dynamixel servos have 9600, 57600"),
        (("l_kneee",), "did you mean 'l_knee'?"),
        (("l_knee", "--id", "5"), "not both"),
        ((), "joint missing"),
    ],
)
def test_what_no_servo_can_be_set_to_is_a_usage_error(bringup: Any, words: tuple[str, ...], said: str) -> None:
    code, answer, _ = bringup("setup", *words, *VIRTUAL)
    assert code == 2
    assert said in answer["error"]


def test_a_fresh_servo_is_adopted_on_a_serial_port_and_the_official_sdk_finds_it(bringup: Any) -> None:
    """A port like any other, in real time; the SDK is the judge."""
    sdk = pytest.importorskip("dynamixel_sdk")
    factory_state = FactoryState(fresh=("l_knee",), only=("l_knee",))
    with RigProcess(ROBOT, clock="real", factory_state=factory_state, linger=60.0) as rig:
        code, answer, err = bringup("setup", "l_knee", "--port", rig.port, "--yes")
        assert code == 0, err
        assert (answer["before"], answer["after"]) == ({"id": 1, "baud": 57600}, {"id": 14, "baud": 2000000})
        sdk.port_handler.LATENCY_TIMER = 300
        port, packet = sdk.PortHandler(rig.port), sdk.PacketHandler(2.0)
        assert port.setBaudRate(2000000)
        assert packet.ping(port, KNEE) == (1020, sdk.COMM_SUCCESS, 0)
        assert packet.read1ByteTxRx(port, KNEE, 8) == (4, sdk.COMM_SUCCESS, 0)
        assert packet.ping(port, 1)[1] != sdk.COMM_SUCCESS
        port.closePort()


# Check ---------------------------------------------------------------------------------------------------------------


def test_differences_are_shown_corrected_and_gone(rig: RigProcess, bringup: Any) -> None:
    write(rig, KNEE, return_delay_time=250, max_position_limit=2500)
    write(rig, 3, homing_offset=100)
    code, answer, err = bringup("check", *VIRTUAL)
    assert (code, answer["ready"], answer["fixed"]) == (1, False, 0)
    wrong = {(d["joint"], d["register"], d["found"], d["grave"]) for d in answer["differences"]}
    assert wrong == {
        ("l_knee", "return_delay_time", 250, False),
        ("l_knee", "max_position_limit", 2500, True),
        ("r_sho_roll", "homing_offset", 100, True),
    }
    assert "must be changed" in err
    assert "check --fix" in err
    write(rig, KNEE, torque_enable=1)
    code, answer, _ = bringup("check", *VIRTUAL, "--fix")
    assert code == 3
    assert "l_knee has torque on" in answer["error"]
    write(rig, KNEE, torque_enable=0)
    code, answer, _ = bringup("check", *VIRTUAL, "--fix")
    assert (code, answer["fixed"], answer["left"], answer["ready"]) == (0, 3, [], True)
    code, answer, _ = bringup("check", *VIRTUAL)
    assert (code, answer["differences"]) == (0, [])


def test_a_missing_servo_is_named(rig: RigProcess, bringup: Any) -> None:
    rig.control.inject("dead", servo="l_knee")
    code, answer, _ = bringup("check", *VIRTUAL)
    assert code == 3
    assert "no answer from l_knee (ID 14): check their cables" in answer["error"]

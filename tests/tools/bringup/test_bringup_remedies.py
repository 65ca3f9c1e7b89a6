"""Every command that `scan`, `check` and `setup` print as a remedy is run in the state that prints it, and cures it."""

from __future__ import annotations

import re
from pathlib import Path
from typing import Any

import pytest
from test_bringup_scan import VIRTUAL, bus_of, write

from servoid.hw.config import CONFIGS
from servoid.hw.dynamixel.protocol.tables import table
from servoid.sim.rig.process.control import RigProcess

XM430 = table("xm430-w350")
COMMAND = re.compile(r"servoid bringup ((?:setup|check|off)[a-z0-9_ -]*)|then (check --fix)")


def commands(texts: list[str]) -> list[list[str]]:
    """The commands in messages, in order."""
    return [(first or then).split() for text in texts for first, then in COMMAND.findall(text)]


def follow(bringup: Any, texts: list[str]) -> None:
    printed = commands(texts)
    assert printed, texts
    for words in printed:
        assert "JOINT" not in words
        yes = ["--yes"] if words[0] in ("setup", "off") else []
        code, answer, _ = bringup(*words, *VIRTUAL, *yes)
        assert code == 0, (words, answer)


@pytest.mark.parametrize(
    "changes",
    [
        {"baud_rate": 1},
        {"id": 33},
        {"id": 33, "baud_rate": 3},
        {"secondary_id": 13},
        {"secondary_id": 13, "id": 33},
    ],
)
def test_what_a_scan_says_of_one_servo_of_an_assembled_robot_can_be_done(
    rig: RigProcess, bringup: Any, changes: dict[str, int]
) -> None:
    """`scan` said that `setup` adopts it, and `setup` said to unplug all but one: of a whole robot."""
    at = 14
    for name, value in changes.items():
        if name == "baud_rate":
            with bus_of(rig) as bus:
                bus.write_item(at, XM430.item(name), value, tries=1)  # answers where nobody listens
        else:
            write(rig, at, **{name: value})
        at = value if name == "id" else at
    code, found, _ = bringup("scan", *VIRTUAL)
    assert code == 3
    follow(bringup, found["problems"])
    code, found, _ = bringup("scan", *VIRTUAL)
    assert (code, found["problems"], found["missing"]) == (0, [], [])
    code, found, _ = bringup("check", *VIRTUAL)
    assert (code, found["ready"]) == (0, True)


def test_of_two_strays_the_remedies_adopt_each(rig: RigProcess, bringup: Any) -> None:
    for id in (14, 13):
        with bus_of(rig) as bus:
            bus.write_item(id, XM430.item("baud_rate"), 1, tries=1)
    code, answer, _ = bringup("setup", "l_knee", *VIRTUAL, "--yes")
    assert code == 3
    assert "2 servos have no joint yet" in answer["error"]
    assert "choose one with --from ID --from-baud N" in answer["error"]
    code, found, _ = bringup("scan", *VIRTUAL)
    follow(bringup, found["problems"])
    assert bringup("scan", *VIRTUAL)[0] == 0


def test_torque_in_the_way_of_each_is_turned_off_as_it_says(rig: RigProcess, bringup: Any) -> None:
    write(rig, 14, id=33)
    write(rig, 33, torque_enable=1)
    code, answer, _ = bringup("setup", "l_knee", *VIRTUAL, "--yes")
    assert code == 3
    follow(bringup, [answer["error"]])
    code, answer, _ = bringup("setup", "l_knee", *VIRTUAL, "--yes")
    assert (code, answer["after"]["id"]) == (0, 14)
    write(rig, 14, torque_enable=1)
    code, answer, _ = bringup("calibrate", *VIRTUAL, "--yes")
    assert code == 3
    follow(bringup, [answer["error"]])


def test_an_id_that_others_have_or_obey_is_not_written_to(rig: RigProcess, bringup: Any) -> None:
    write(rig, 14, id=33)
    write(rig, 13, secondary_id=33)
    code, answer, _ = bringup("setup", "l_knee", *VIRTUAL, "--yes")
    assert code == 3
    assert "ID 13, 2000000 bit/s obeys ID 33 too (its secondary ID)" in answer["error"]
    code, answer, _ = bringup("setup", "r_knee", "--from", "33", *VIRTUAL, "--yes")
    assert code == 3
    assert "ID 13 at 2000000 bit/s is r_knee (ID 13) already" in answer["error"] or "obeys ID 33" in answer["error"]


def test_check_sees_a_servo_of_nobody_on_the_robots_bus(rig: RigProcess, bringup: Any, tmp_path: Path) -> None:
    """All registers of the joints may be right, and what is written to one moves the stranger too."""
    text = (CONFIGS / "robots" / "op3.yaml").read_text().replace("op3.xml", str(CONFIGS / "robots" / "op3.xml"))
    lines = [line for line in text.splitlines() if "name: head_" not in line]  # a robot without a head, on this rig
    (tmp_path / "headless.yaml").write_text("\n".join([*lines, "passive: [head_pan, head_tilt]"]))
    write(rig, 20, secondary_id=14)
    code, found, _ = bringup("check", *VIRTUAL, "--robot", str(tmp_path / "headless.yaml"))
    assert (code, found["differences"], found["ready"]) == (1, [], False)
    assert len(found["strangers"]) == 2
    assert any("ID 20, 2000000 bit/s: obeys ID 14 too (its secondary ID)" in text for text in found["strangers"])

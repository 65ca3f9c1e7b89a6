"""Torque that another program left on: `scan` and `check` name it, and `servoid bringup off` turns it off."""

from __future__ import annotations

from typing import Any

import pytest
from test_bringup_scan import AT_2M, VIRTUAL, bus_of, write

from servoid.hw.dynamixel.protocol.tables import table
from servoid.sim.rig.process.control import RigProcess

XM430 = table("xm430-w350")


def test_torque_that_is_on_is_named_and_turned_off(rig: RigProcess, bringup: Any) -> None:
    write(rig, 14, position_p_gain=640, torque_enable=1)
    code, found, err = bringup("scan", *AT_2M)
    assert (code, found["torque"]) == (0, ["l_knee (ID 14)"])
    assert "torque is on at l_knee (ID 14): servoid bringup off turns it off" in err
    code, found, err = bringup("check", *VIRTUAL)
    assert (code, found["torque"]) == (0, ["l_knee (ID 14)"])
    assert "servoid bringup off" in err
    code, found, err = bringup("off", *VIRTUAL, "--yes")
    assert (code, found["off"]) == (0, ["l_knee (ID 14)"])
    states = {state["id"]: state for state in rig.control.servos()}
    assert not states[14]["torque"]
    assert states[14]["position_p_gain"] == 640, "gains are as they were: other programs rely on them"
    code, found, err = bringup("off", *VIRTUAL, "--yes")
    assert (code, found["off"]) == (0, [])
    assert "20 servos answer at 2000000 bit/s, and none has torque" in err


def test_nothing_goes_limp_without_a_yes(rig: RigProcess, bringup: Any, monkeypatch: pytest.MonkeyPatch) -> None:
    import io

    write(rig, 14, torque_enable=1)
    monkeypatch.setattr("sys.stdin", io.StringIO("n\n"))
    code, _, _ = bringup("off", *VIRTUAL)
    assert code == 130
    assert next(state for state in rig.control.servos() if state["id"] == 14)["torque"]


def test_registers_that_torque_locks_are_corrected_after_off(rig: RigProcess, bringup: Any) -> None:
    """The remedy that `check --fix` prints leads there."""
    write(rig, 14, pwm_limit=100)
    write(rig, 13, torque_enable=1)
    code, answer, _ = bringup("check", *VIRTUAL, "--fix")
    assert code == 3
    assert (
        "r_knee has torque on, which locks its registers: hold the robot, then servoid bringup off" in answer["error"]
    )
    assert bringup("off", *VIRTUAL, "--yes")[0] == 0
    code, answer, _ = bringup("check", *VIRTUAL, "--fix")
    assert (code, answer["fixed"]) == (0, 1)
    with bus_of(rig) as bus:
        assert bus.read_item(14, XM430.item("pwm_limit")) == 885

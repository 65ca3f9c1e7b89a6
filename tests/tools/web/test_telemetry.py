"""The numbers of the page: what is near the robot's own limits, what is counted, and why the robot stopped."""

from __future__ import annotations

import json
from dataclasses import replace

import numpy as np
import pytest

from servoid.hw.faults import OVERHEATING
from servoid.hw.robot.description import load_robot
from servoid.stack.safety.event import Event
from servoid.tools.web.browser.telemetry import COLUMNS, FINE, HISTORY, NEAR, OVER, Telemetry, levels
from servoid.tools.web.line.snapshot import RunInfo, Snapshot

ROBOT = load_robot()
N = len(ROBOT.names)
KNEE = ROBOT.names.index("l_knee")
FULL = np.array([servo.stall_torque / servo.stiffness for servo in ROBOT.servos])


def snapshot(**change: object) -> Snapshot:
    """Of a robot that is well; `change` names values, an array's for the left knee alone."""
    values = {
        "position": ROBOT.home,
        "target": ROBOT.home,
        "effort": np.zeros(N),
        "temperature": np.full(N, 30.0),
        "voltage": np.full(N, 12.0),
        "age": np.zeros(N),
        "fault": np.zeros(N, int),
        "gain": np.ones(N),
    }
    for name in values.keys() & change.keys():
        values[name] = values[name].copy()
        values[name][KNEE] = change.pop(name)  # type: ignore[call-overload]
    other = {"tick": 1, "time": 1.0, "phase": "running", "late": 0.1, "busy": 2.0, "missed": 0} | change
    return Snapshot(**values, **other)  # type: ignore[arg-type]


@pytest.mark.parametrize(
    ("column", "change", "level"),
    [
        ("temperature", {"temperature": ROBOT.limits.temperature + 1}, OVER),
        ("temperature", {"temperature": (ROBOT.limits.derate_temperature or 0.0) + 1}, NEAR),
        ("temperature", {"temperature": np.nan}, FINE),  # not read is no limit that was passed
        ("voltage", {"voltage": ROBOT.servos[KNEE].voltage_range[0] - 0.1}, OVER),
        ("voltage", {"voltage": (ROBOT.limits.derate_voltage or 0.0) - 0.1}, NEAR),
        ("position", {"position": ROBOT.upper[KNEE] + 0.01}, OVER),
        ("position", {"position": ROBOT.upper[KNEE] - ROBOT.limits.margin / 2}, NEAR),
        ("target", {"target": ROBOT.home[KNEE] + FULL[KNEE]}, OVER),
        ("effort", {"effort": -ROBOT.servos[KNEE].stall_torque}, OVER),
        ("age", {"age": (ROBOT.limits.stale + 1) * ROBOT.dt}, OVER),
        ("age", {"age": 2 * ROBOT.dt}, NEAR),
        ("gain", {"gain": 0.6}, NEAR),
    ],
)
def test_a_value_near_its_limit_is_marked_and_no_other(column: str, change: dict[str, float], level: int) -> None:
    found = levels(ROBOT, snapshot(**change), FULL)
    assert found[KNEE, COLUMNS.index(column)] == level
    assert not np.delete(found, KNEE, axis=0).any()


def test_a_frame_is_json_whatever_was_not_measured() -> None:
    frame = json.loads(Telemetry(ROBOT).tick(snapshot(position=np.nan, age=np.inf, fault=OVERHEATING)))
    assert frame["values"][KNEE][0] is None
    assert frame["values"][KNEE][COLUMNS.index("age")] is None
    assert frame["faults"] == {"l_knee": "overheating"}
    assert frame["unread"] == 1


def test_why_a_robot_stopped_is_the_first_reason_and_stays() -> None:
    telemetry = Telemetry(ROBOT)
    events = (Event(1, 1.0, "fall", None, "tilted by 61 degrees"), Event(1, 1.0, "phase", None, "damped"))
    assert json.loads(telemetry.tick(snapshot()))["why"] == ""
    assert json.loads(telemetry.tick(snapshot(phase="fault", events=events)))["why"] == "tilted by 61 degrees"
    later = (Event(2, 1.1, "interrupt", None, "once more"),)
    assert json.loads(telemetry.tick(snapshot(phase="fault", events=later)))["why"] == "tilted by 61 degrees"
    telemetry.begin(RunInfo("op3", "walk", "sim", "gait", simulated=True))
    assert json.loads(telemetry.tick(snapshot()))["why"] == ""


def test_who_comes_late_sees_the_last_seconds() -> None:
    telemetry = Telemetry(ROBOT)
    for tick in range(1500):
        telemetry.tick(replace(snapshot(), tick=tick, time=tick * 0.02, missed=tick % 2))
    history = json.loads(telemetry.hello())["history"]
    assert history[-1]["time"] - history[0]["time"] == pytest.approx(HISTORY, abs=0.03)
    assert history[-1]["missed"] == 750

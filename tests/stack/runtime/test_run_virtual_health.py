"""A walk on the virtual rig that something ends in order: named over real bytes, lowered, and off."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from servoid.hw.contracts.body import Mode
from servoid.hw.robot.description import load_robot
from servoid.sim.rig.process.backend import VirtualBackend
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.run import Result, RunSettings, run
from servoid.stack.safety.health import DERATED
from servoid.stack.safety.phase import Phase

ROBOT = load_robot()
AT = 90  # the tick that it happens at: while walking


class Watched(VirtualBackend):
    """Notes the servos' torque when the loop has ended, before closing switches anything, and the gains they took."""

    torque: tuple[int, ...] = ()
    gains: tuple[tuple[str, int], ...] = ()

    def close(self) -> None:
        if self._rig is not None:
            control = self.rig.control
            self.torque = tuple(servo["torque"] for servo in control.servos())
            taken = [entry for entry in control.accepted() if entry["register"] == "position_p_gain"]
            self.gains = tuple((ROBOT.names[entry["joint"]], entry["value"]) for entry in taken)
        super().close()


def walk(happens: Any, robot: Any = ROBOT, seconds: float = 20.0) -> tuple[Result, list[TickRecord], Watched]:
    body, records = Watched(robot), []

    def note(record: TickRecord) -> None:
        records.append(record)
        if record.tick == AT:
            assert record.phase is Phase.RUNNING
            happens(body.rig.control)

    result = run(RunSettings("walk", policy="gait", seconds=seconds, backend="virtual"), backend=body, on_tick=note)
    return result, records, body


@pytest.mark.slow
@pytest.mark.parametrize(
    ("happens", "kind", "joint", "words"),
    [
        (lambda rig: rig.press(1), "button", None, "stop button"),
        (lambda rig: rig.inject("heat", servo="l_knee", value=73), "temperature", "l_knee", "73 C"),
        (lambda rig: rig.inject("brown_out", value=9.8, until=9.0), "voltage", ..., "charge the battery"),
        (lambda rig: rig.inject("voltage", servo="r_el"), "voltage", "r_el", "input voltage"),
    ],
)
def test_it_is_named_within_10_ticks_and_the_robot_lowered(happens: Any, kind: str, joint: Any, words: str) -> None:
    result, records, body = walk(happens)
    event = next(event for event in result.events if event.kind == kind)
    assert AT < event.tick <= AT + 10
    assert words in event.text
    assert event.joint in (ROBOT.names if joint is ... else (joint,))
    phases = [record.phase for record in records if record.tick >= AT]
    assert [phases[i] for i in np.flatnonzero(np.diff([list(Phase).index(p) for p in phases]))] == [
        Phase.RUNNING,
        Phase.STOPPING,
        Phase.LOWERING,
    ], "brought to rest, lowered, then damped"
    assert records[-1].command.mode is Mode.OFF
    assert body.torque == (0,) * 20
    assert result.outcome == "stopped"


@pytest.mark.slow
def test_a_warm_servo_is_softened_on_the_wire_and_the_walk_goes_on() -> None:
    result, _, body = walk(lambda rig: rig.inject("heat", servo="l_knee", value=66), seconds=1.5)
    assert result.outcome == "succeeded"
    derated = [event for event in result.events if event.kind == "derated"]
    assert {event.joint for event in derated} == {"l_knee"}
    assert body.torque == (0,) * 20
    lowered = [(name, gain) for name, gain in body.gains if 0 < gain < 800]
    assert {name for name, _ in lowered} == {"l_knee"}
    assert min(gain for _, gain in lowered) >= 800 * DERATED


@pytest.mark.slow
def test_a_robot_whose_imu_has_its_own_port_walks_on_the_rig_with_the_boards() -> None:
    """However it is mounted there: the rig mounts its own the same way."""
    own = replace(ROBOT.imu, kind="witmotion", port="/dev/nothing", signs=(1.0, 1.0, 1.0), mounting=(0.3, -1.2, 2.0))
    path = []
    for robot in (ROBOT, replace(ROBOT, imu=own)):
        result, records, _ = walk(lambda rig: None, robot, 1.5)
        assert result.outcome == "succeeded"
        path.append(records[100].observation.specific_force)
    np.testing.assert_allclose(path[0], path[1], atol=0.3)

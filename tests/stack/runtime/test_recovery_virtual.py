"""Falls on the virtual rig, over real bytes: the robot gets up, or its servos are off."""

from __future__ import annotations

import signal
from typing import Any

import numpy as np
import pytest

from servoid.hw.robot.description import load_robot
from servoid.sim.rig.process.backend import VirtualBackend
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.run import Result, RunSettings, run
from servoid.stack.safety.phase import DOWN, Phase
from servoid.tools.faults.trial import unsafe_goals

ROBOT = load_robot()
AT = 60  # the tick of the task at which the robot is pushed over


class Watched(VirtualBackend):
    """Notes the servos' torque when the loop has ended, before closing switches anything."""

    torque: tuple[int, ...] = ()

    def close(self) -> None:
        if self._rig is not None:
            self.torque = tuple(servo["torque"] for servo in self.rig.control.servos())
        super().close()


def fall(bearing: float, seconds: float, then: Any = None) -> tuple[Result, list[TickRecord], list[Any], Watched]:
    """A walk in which the robot is pushed over; `then` is called with each tick and the rig's control."""
    body, records, accepted, ticks = Watched(ROBOT), list[TickRecord](), list[Any](), list[int]()

    def note(record: TickRecord) -> None:
        records.append(record)
        if record.tick % 25 == 0:
            accepted.extend(body.rig.control.accepted())
        if record.proposal.instruction is not None:
            ticks.append(record.tick)
            if len(ticks) == AT:
                body.rig.control.push(1.5 * np.array([np.cos(bearing), np.sin(bearing)]))
        if then is not None:
            then(record, body.rig.control)

    settings = RunSettings("walk", policy="gait", backend="virtual", seconds=seconds, set={"vx": "0.1"}, recover=True)
    return run(settings, backend=body, on_tick=note), records, accepted, body


@pytest.mark.slow
@pytest.mark.parametrize("bearing", [0.0, np.pi, np.pi / 2], ids=["front", "back", "side"])
def test_it_gets_up_and_no_servo_took_an_unsafe_goal(bearing: float) -> None:
    result, records, accepted, body = fall(bearing, 16.0)
    assert result.outcome == "succeeded"
    phases = {record.phase for record in records}
    assert phases >= {*DOWN, Phase.LOWERING}
    assert Phase.FAULT not in phases
    assert unsafe_goals(ROBOT, accepted) == []
    assert body.torque == (0,) * 20


@pytest.mark.slow
@pytest.mark.parametrize("phase", sorted(DOWN))
@pytest.mark.parametrize("what", ["overload", "interrupt"])
def test_a_servos_error_or_ctrl_c_while_it_is_down_ends_with_torque_off(phase: Phase, what: str) -> None:
    happened: list[int] = []

    def happen(record: TickRecord, control: Any) -> None:
        if record.phase is phase and not happened:
            happened.append(record.tick)
            if what == "interrupt":
                signal.raise_signal(signal.SIGINT)
            else:
                control.inject("overload", servo="l_knee")

    result, records, _, body = fall(0.0, 8.0, happen)
    event = next(event for event in result.events if event.kind == ("servo" if what == "overload" else what))
    assert happened[0] < event.tick <= happened[0] + 10
    assert event.joint == ("l_knee" if what == "overload" else None)
    assert records[-1].tick <= event.tick + 0.5 * ROBOT.rate
    assert result.outcome == ("stopped" if what == "overload" else "interrupted")
    assert result.trace.fallen
    assert body.torque == (0,) * 20

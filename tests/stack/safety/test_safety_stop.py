"""A robot that is told to stop: it comes to rest, is lowered, and goes limp only then (invariant 7)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fake_body import tilted
from test_safety import ROBOT, N, Rig

from servoid.hw.contracts.body import Mode
from servoid.stack.safety.guard import PATIENCE, REST_SECONDS, REST_WINDOW
from servoid.stack.safety.health import BLOCKED
from servoid.stack.safety.phase import Phase


def test_heat_lowers_before_it_damps():
    rig = Rig().running()
    rig.step(ROBOT.home, spoil=lambda o: replace(o, temperature=np.where(np.arange(N) == 11, 75.0, np.nan)))
    assert rig.guard.phase is Phase.STOPPING
    rig.until(Phase.LOWERING)
    rig.until(Phase.DAMPED)
    active = [command for command in rig.body.sent if command.mode is Mode.ACTIVE]
    np.testing.assert_allclose(active[-1].position, rig.guard.lowest, atol=1e-9)


def steps(tick):
    """A joint that swings as in a walk: to and fro in half a second."""
    return ROBOT.home + 0.1 * np.sin(2.0 * np.pi * tick / 24.0)


def test_a_robot_that_stops_follows_its_policy_until_it_rests_and_is_lowered_then():
    rig = Rig().running()
    for tick in range(50):
        rig.step(steps(tick))
    rig.guard.stop("interrupt", "Ctrl-C")
    for tick in range(50, 74):
        rig.step(steps(tick))
        assert rig.guard.phase is Phase.STOPPING
    assert np.ptp([command.position for command in rig.body.sent[-24:]], axis=0).min() > 0.1  # rad: not held
    rig.guard.stop("task", "done")  # it is ending already
    assert rig.kinds().count("task") == 0
    still = round(REST_WINDOW * ROBOT.rate)
    for _ in range(still + 5):  # some ticks of the way to the pose that it rests in
        rig.step(ROBOT.home)
    assert rig.guard.phase is Phase.LOWERING
    assert rig.guard.cause == "interrupt"


def test_a_robot_that_sits_is_damped_as_it_sits():
    """Asked to stand, or lowered, it would push itself off the seat."""
    rig = Rig().running()
    rig.step(ROBOT.home)
    rig.guard.sits = True
    rig.guard.stop("interrupt", "Ctrl-C")
    assert rig.guard.phase is Phase.DAMPED
    rig.step(ROBOT.home)
    assert rig.body.sent[-1].mode is Mode.DAMP
    rig = Rig().running()
    rig.guard.sits, rig.guard.sits = True, False  # it has risen since
    rig.guard.stop("task", "done")
    assert rig.guard.phase is Phase.STOPPING


def test_a_robot_that_does_not_come_to_rest_is_lowered_all_the_same():
    rig = Rig().running()
    rig.guard.stop("interrupt", "Ctrl-C")
    ticks = 0
    while rig.guard.phase is not Phase.LOWERING:
        rig.step(steps(ticks))
        ticks += 1
    assert ticks * ROBOT.dt == pytest.approx(REST_SECONDS, abs=2 * ROBOT.dt)


def test_a_blocked_joint_takes_no_step_more():
    for before in (None, "interrupt"):
        rig = Rig().running()
        if before:
            rig.guard.stop(before, "Ctrl-C")
        rig.guard.stop(BLOCKED, "l_knee pushes against something")
        assert rig.guard.phase is Phase.LOWERING


def test_time_to_rest_is_time_and_not_decisions():
    """A slow policy lets ticks pass."""
    rig = Rig().running()
    rig.guard.stop("interrupt", "Ctrl-C")
    began = rig.tick
    while rig.guard.phase is not Phase.LOWERING:
        rig.step(steps(rig.tick), ticks=3)
    assert (rig.tick - began) * ROBOT.dt <= REST_SECONDS + 3 * ROBOT.dt


def test_a_policy_that_fails_while_it_stops_has_the_robot_lowered_and_not_dropped():
    for broken in (np.full(N, np.nan), np.zeros(N + 1)):
        rig = Rig().running()
        rig.guard.stop("interrupt", "Ctrl-C")
        for _ in range(PATIENCE):
            rig.step(broken)
        assert rig.guard.phase is Phase.LOWERING
        assert rig.guard.cause == "interrupt"
        assert "policy" in rig.kinds()


def test_a_person_who_stops_what_is_stopping_is_told_once_that_it_was_heard():
    rig = Rig().running()
    rig.guard.stop("task", "done")
    for _ in range(3):
        rig.guard.stop("button", "the stop button was pressed")
        rig.guard.stop("temperature", "hot")
    rig.step()
    assert rig.kinds().count("button") == 1
    assert rig.kinds().count("temperature") == 0
    assert rig.guard.cause == "task"


@pytest.mark.parametrize("phase", [Phase.STOPPING, Phase.LOWERING])
def test_a_fall_while_stopping_or_lowering_damps(phase):
    rig = Rig().running()
    rig.guard.stop("interrupt", "Ctrl-C")
    rig.until(phase)
    rig.step()
    assert rig.step(spoil=lambda o: tilted(o, 1.3)).mode is Mode.DAMP

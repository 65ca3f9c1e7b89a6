"""A robot that is to get up again after a fall: what the guard lets it do, and what ends it (invariant 9)."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fake_body import spoiled, tilted
from hypothesis import given, settings
from hypothesis import strategies as st
from test_safety import HIGH, LOW, ROBOT, STEP, N, Rig, proposals

from servoid.hw.contracts.body import Mode
from servoid.hw.faults import OVERLOAD, STOP_BUTTON, STOP_BUTTON_AGAIN
from servoid.stack.safety.guard import DAMP_SECONDS, Guard
from servoid.stack.safety.health import BLOCKED_SECONDS, DERATED
from servoid.stack.safety.phase import DOWN, Phase
from servoid.stack.safety.recovery import (
    BRACE_GAIN,
    BRACE_SECONDS,
    LOAD,
    RESTLESS_SECONDS,
    SECONDS,
    STILL_SECONDS,
    TRIES,
)

KNEE = ROBOT.names.index("l_knee")
LEGS = np.isin(np.arange(N), ROBOT.leg_index)


def lying(o):
    return tilted(o, 1.5)


def rolling(o):
    return replace(lying(o), angular_velocity=np.array([1.0, 0.0, 0.0]))


class Faller(Rig):
    """A rig whose robot lies on its side from `fall` on."""

    def __init__(self):
        super().__init__()
        self.guard = Guard(ROBOT, self.body, recover=True)

    def fall(self):
        self.step(ROBOT.home, spoil=lying)
        assert self.guard.phase is Phase.FALLEN
        return self

    def rising(self):
        return self.until(Phase.RECOVERING, spoil=lying)


def fallen(phase=Phase.FALLEN):
    rig = Faller().running()
    rig.step(ROBOT.home)
    rig.fall()
    return rig if phase is Phase.FALLEN else rig.rising()


def test_9_in_a_fall_gains_go_down_at_once_and_the_arms_come_in_and_then_all_brakes():
    rig = Faller().running()
    for _ in range(20):
        rig.step(ROBOT.home + np.where(LEGS, 0.0, 0.5))
    command = rig.step(ROBOT.home, spoil=lying)
    np.testing.assert_array_equal(command.gain, np.where(LEGS, 0.0, BRACE_GAIN))
    for _ in range(round(BRACE_SECONDS * ROBOT.rate)):
        command = rig.step(np.ones(N), spoil=rolling)
    np.testing.assert_allclose(command.position[~LEGS], ROBOT.home[~LEGS], atol=1e-9)
    for _ in range(20):
        command = rig.step(np.ones(N), spoil=rolling)  # what is proposed meanwhile moves nothing
        assert not command.gain.any()
        np.testing.assert_allclose(command.position, ROBOT.home, atol=1e-9)
    assert rig.guard.phase is Phase.FALLEN
    assert rig.kinds().count("fall") == 1


def test_9_it_is_moved_when_it_has_lain_still_and_its_goals_are_then_where_its_joints_are():
    rig = fallen()
    bent = np.clip(ROBOT.home + 0.4, LOW, HIGH)
    rig.body.position = bent
    began = rig.tick
    while rig.guard.phase is Phase.FALLEN:
        rig.body.position = bent  # it has no gains to leave it by
        command = rig.step(spoil=lying)
    assert rig.guard.phase is Phase.RECOVERING
    assert (rig.tick - began) * ROBOT.dt >= STILL_SECONDS
    np.testing.assert_allclose(command.position, bent, atol=1e-9)
    np.testing.assert_array_equal(command.gain, 1.0)


@pytest.mark.parametrize("phase", [Phase.STOPPING, Phase.LOWERING])
def test_9_only_a_robot_that_runs_gets_up(phase):
    rig = Faller()
    rig.guard.home(rig.body.read())
    rig.until(Phase.READY)
    rig.guard.start()
    rig.guard.stop("interrupt", "Ctrl-C")
    rig.until(phase)
    rig.step()
    assert rig.step(spoil=lying).mode is Mode.DAMP
    assert rig.guard.phase is Phase.FAULT


def test_9_without_being_asked_to_a_fall_is_the_end():
    rig = Rig().running()
    assert rig.step(spoil=lying).mode is Mode.DAMP
    assert rig.guard.phase is Phase.FAULT
    assert not rig.guard.down


@settings(max_examples=60, deadline=None)
@given(proposals, st.lists(st.floats(-3, 3), min_size=N, max_size=N))
def test_1_2_getting_up_no_command_leaves_range_or_rate(sequence, pose):
    """From the fall on, wherever the limp joints were turned to in between."""
    rig = fallen()
    previous = rig.guard.applied
    turned = np.clip(np.array(pose), ROBOT.lower, ROBOT.upper)
    for _ in range(200):
        if rig.guard.phase is Phase.RECOVERING:
            break
        rig.body.position = turned
        command = rig.step(spoil=lying)
        assert np.abs(command.position - previous).max() <= STEP + 1e-9
        assert ((command.position >= LOW - 1e-9) & (command.position <= HIGH + 1e-9)).all()
        previous = command.position
    accepted = rig.tick
    for target, ticks in sequence:
        command = rig.step(target, ticks, spoil=lying)
        if command.mode is not Mode.ACTIVE or rig.guard.phase is not Phase.RECOVERING:
            break
        assert np.isfinite(command.position).all()
        assert ((command.position >= LOW - 1e-9) & (command.position <= HIGH + 1e-9)).all()
        assert np.abs(command.position - previous).max() <= STEP * min(rig.tick - accepted, ROBOT.limits.stale) + 1e-9
        if np.isfinite(target).all():
            accepted = rig.tick
        previous = command.position


def failing(joint, **what):
    def spoil(o):
        changed = {key: np.where(np.arange(N) == joint, value, getattr(o, key)) for key, value in what.items()}
        return replace(lying(o), **changed)

    return spoil


ENDINGS = {
    "servo": failing(KNEE, fault=OVERLOAD),
    "stale": lambda o: spoiled(lying(o), [KNEE]),
    "temperature": failing(KNEE, temperature=75.0),
    "voltage": lambda o: replace(lying(o), voltage=np.full(N, 9.0)),
    "button": failing(0, fault=STOP_BUTTON),
    "button twice": failing(0, fault=STOP_BUTTON | STOP_BUTTON_AGAIN),
}


@pytest.mark.parametrize("phase", sorted(DOWN))
@pytest.mark.parametrize("what", ENDINGS)
def test_9_what_ends_a_run_damps_a_robot_that_is_down_at_once(phase, what):
    rig = fallen(phase)
    ticks = 0
    while rig.guard.phase in DOWN:
        rig.step(ROBOT.home, spoil=ENDINGS[what])
        ticks += 1
    assert ticks <= 10
    assert rig.guard.cause == what.split()[0]
    modes = [rig.step(spoil=lying).mode for _ in range(round(DAMP_SECONDS * ROBOT.rate) + 2)]
    assert Mode.ACTIVE not in modes
    assert rig.guard.off
    assert rig.guard.down


@pytest.mark.parametrize("phase", sorted(DOWN))
def test_9_ctrl_c_damps_a_robot_that_is_down_at_once(phase):
    rig = fallen(phase)
    rig.guard.stop("interrupt", "Ctrl-C")
    assert rig.step(ROBOT.home, spoil=lying).mode is Mode.DAMP
    rig = fallen(phase)
    rig.guard.release()
    assert rig.body.sent[-1].mode is Mode.OFF


def test_9_a_joint_that_pushes_in_vain_ends_it_by_its_own_limit_and_keeps_its_strength_until_then():
    """A knee that lifts the robot pushes for longer than one that walks does; one that is pressed down never moves."""
    rig = fallen(Phase.RECOVERING)
    stuck = rig.body.position[KNEE]
    target = np.where(np.arange(N) == KNEE, np.clip(stuck + 1.0, LOW, HIGH), ROBOT.home)
    ticks = 0
    while rig.guard.phase is Phase.RECOVERING:
        command = rig.step(target, spoil=lambda o: failing(KNEE, position=stuck)(o))
        ticks += 1
        if rig.guard.phase is Phase.RECOVERING:
            assert command.gain[KNEE] == 1.0
    assert BLOCKED_SECONDS < LOAD.blocked <= ticks * ROBOT.dt < LOAD.blocked + 0.5
    assert rig.guard.phase is Phase.DAMPED
    assert rig.guard.cause == "overload"
    assert [event.joint for event in rig.events if event.kind == "overload"] == ["l_knee"]


def homed(away, *, recover=True, held=KNEE, spoil=failing):
    """A guard that brings a robot home, one of whose joints does not move from `away` [rad] off home. Yields the guard,
    and how far that joint is off the goal, at each tick."""
    rig = Faller() if recover else Rig()
    stuck = np.where(np.arange(N) == held, ROBOT.home + away, ROBOT.home)
    rig.body.position = stuck.copy()
    rig.guard.home(rig.body.read())
    while rig.guard.phase is Phase.HOMING:
        rig.step(spoil=spoil(held, position=stuck[held]))
        yield rig, abs(rig.guard.applied[held] - stuck[held])


def standing(joint, **what):
    return lambda o: replace(failing(joint, **what)(o), **{k: getattr(o, k) for k in ("orientation", "specific_force")})


def test_9_a_robot_that_lies_on_its_leg_as_it_begins_is_brought_home_without_pushing_with_all_it_has():
    """It was stopped as blocked, or its leg went soft for the rest of the run, before it could begin to rise."""
    servo = ROBOT.servos[KNEE]
    ticks = list(homed(1.2))
    rig, off = ticks[-1]
    assert max(off for _, off in ticks) <= DERATED * servo.stall_torque / servo.stiffness + STEP
    assert off > 0.1, "it does try"
    assert rig.guard.phase is Phase.READY
    np.testing.assert_array_equal(rig.step(spoil=failing(KNEE)).gain[LEGS], 0.0)
    assert rig.guard.phase is Phase.FALLEN
    rig.rising()
    np.testing.assert_array_equal(rig.step(spoil=lying).gain, 1.0)
    assert not {"derated", "overload", "homing"} & set(rig.kinds())


@pytest.mark.parametrize(("recover", "spoil"), [(False, failing), (True, standing)])
def test_9_one_that_does_not_get_up_by_itself_or_hangs_upright_is_still_stopped_by_a_blocked_joint(recover, spoil):
    rig, _ = list(homed(1.2, recover=recover, spoil=spoil))[-1]
    assert rig.guard.phase is Phase.DAMPED
    assert rig.guard.cause == "overload"


def test_9_a_goal_follows_a_joint_that_is_pushed_away_before_it_goes_soft_and_within_the_limit_of_rate():
    """A robot that comes down on its leg as it begins bends it at once, by more than slow homing takes back in time."""
    rig = Faller()
    rig.body.position[0] += 1.0  # the head, which gives homing something to do
    rig.guard.home(rig.body.read())
    for _ in range(40):
        before = rig.guard.applied
        command = rig.step(spoil=failing(KNEE, position=ROBOT.home[KNEE] + 1.0))
        assert np.abs(command.position - before).max() <= STEP + 1e-9
        assert rig.guard.phase is Phase.HOMING
    assert command.position[KNEE] > ROBOT.home[KNEE] + 0.5
    np.testing.assert_array_equal(command.gain, 1.0)


def test_9_it_gives_up_after_three_tries():
    rig = fallen(Phase.RECOVERING)
    for number in range(1, TRIES):
        rig.guard.lie_down(f"try {number} failed")
        assert not rig.step(ROBOT.home, spoil=lying).gain[LEGS].any()
        rig.rising()
    rig.guard.lie_down("the last try failed")
    rig.step(ROBOT.home, spoil=lying)
    assert rig.guard.phase is Phase.FAULT
    assert rig.guard.cause == "fall"
    assert "3 tries to get up have failed" in rig.events[-2].text
    assert rig.kinds().count("recovery") == TRIES


def test_9_it_gives_up_when_its_time_is_over():
    rig = fallen(Phase.RECOVERING)
    while rig.guard.phase is Phase.RECOVERING:
        rig.step(ROBOT.home, spoil=lying)
    assert rig.guard.phase is Phase.FAULT
    assert rig.tick * ROBOT.dt == pytest.approx(SECONDS, abs=0.2)
    assert "20 s" in rig.events[-2].text


def test_9_one_that_is_held_or_carried_is_not_moved():
    rig = fallen()
    began = rig.tick
    while rig.guard.phase is Phase.FALLEN:
        rig.step(ROBOT.home, spoil=rolling)
    assert rig.guard.phase is Phase.FAULT
    assert (rig.tick - began) * ROBOT.dt == pytest.approx(RESTLESS_SECONDS + BRACE_SECONDS, abs=0.1)
    assert "is it held" in rig.events[-2].text


def test_9_it_runs_on_only_when_it_has_stood_still_at_home():
    rig = fallen(Phase.RECOVERING)
    with pytest.raises(RuntimeError, match="does not stand"):
        rig.guard.go_on()
    away = np.where(np.arange(N) == 0, 0.5, ROBOT.home)  # it stands, and looks aside
    for _ in range(40):
        rig.step(away)
    assert rig.guard.recovery.stands
    with pytest.raises(RuntimeError, match="does not stand"):
        rig.guard.go_on()
    for _ in range(round(STILL_SECONDS * ROBOT.rate)):
        rig.step(ROBOT.home)
    rig.guard.go_on()
    assert rig.guard.phase is Phase.RUNNING
    assert not rig.guard.down
    rig.fall()  # and the next fall has its own tries
    assert rig.guard.recovery.tries == 0


def test_9_soles_that_are_not_flat_do_not_count_as_standing():
    rig = fallen(Phase.RECOVERING)
    ankle = ROBOT.names.index("l_ank_pitch")
    for _ in range(60):
        rig.step(np.where(np.arange(N) == ankle, ROBOT.home + 0.3, ROBOT.home))
    assert not rig.guard.recovery.stands

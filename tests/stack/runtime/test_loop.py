"""The loop: order of a tick, missed ticks, and a safe end whatever breaks."""

from __future__ import annotations

import signal

import numpy as np
import pytest
from fake_body import FakeBody, StillEstimator, spoiled

from servoid.hw.contracts.body import BackendError, Mode
from servoid.hw.robot.description import load_robot
from servoid.stack.log.tick import Proposal
from servoid.stack.runtime.clock import Schedule
from servoid.stack.runtime.interrupt import TWICE, Interrupt, Stops
from servoid.stack.runtime.loop import ControlledRobot, Loop
from servoid.stack.safety.event import Event
from servoid.stack.safety.guard import Guard
from servoid.stack.safety.phase import Phase

ROBOT = load_robot("op3")


class Homes:
    """Homes, starts, then proposes `targets(tick)`."""

    def __init__(self, guard, targets):
        self.guard, self.targets, self.ticks = guard, targets, []

    def act(self, tick, observation, state):
        if self.guard.phase is Phase.LIMP and state is not None:
            self.guard.home(observation)
        elif self.guard.phase is Phase.READY:
            self.guard.start()
        elif self.guard.phase is Phase.RUNNING:
            self.ticks.append(tick)
            return Proposal(self.targets(tick))
        return Proposal()


def make(targets=lambda tick: ROBOT.home, script=(), listeners=(), failure=lambda: None):
    body = FakeBody(ROBOT)
    guard = Guard(ROBOT, body)
    interrupt = Interrupt()
    records = []
    loop = Loop(
        ControlledRobot(ROBOT, body, StillEstimator(ROBOT), guard),
        Homes(guard, targets),
        Schedule(body.clock, ROBOT.rate),
        interrupt,
        Stops(interrupt, failure, script),
        (records.append, *listeners),
    )
    return body, guard, interrupt, loop, records


def modes(body):
    return [command.mode for command in body.sent]


def stop_at(tick, text="stop"):
    return Event(tick, 0.0, "interrupt", None, text)


def test_a_run_ends_lowered_damped_and_off():
    body, guard, _, loop, records = make(script=[stop_at(60)])
    loop.run()
    sent = modes(body)
    assert sent[-1] is Mode.OFF
    assert sent.count(Mode.OFF) == 1
    first_damp = sent.index(Mode.DAMP)
    assert all(mode is Mode.ACTIVE for mode in sent[:first_damp])
    assert all(mode is Mode.DAMP for mode in sent[first_damp:-1])
    np.testing.assert_allclose(body.sent[first_damp - 1].position, guard.lowest, atol=1e-9)
    assert [record.tick for record in records] == list(range(len(records)))
    assert sum(record.timing.missed for record in records) == 0


def test_a_slow_tick_is_skipped_over_and_the_target_gets_no_leap():
    def targets(tick):
        if tick == 30:
            body.clock.now += 95_000_000  # the policy thinks for nearly five ticks
        return ROBOT.upper

    body, _, _, loop, records = make(targets, script=[stop_at(60)])
    loop.run()
    ticks = [record.tick for record in records]
    assert 30 in ticks
    assert 34 in ticks
    assert not {31, 32, 33} & set(ticks)
    assert sum(record.timing.missed for record in records) == 3
    told = loop._estimator.ticks
    assert (told[ticks.index(34)], sum(told) - len(told)) == (4, 3), "the estimator knows of the missed ones"
    leaps = np.abs(np.diff([command.position for command in body.sent], axis=0)).max()
    assert leaps <= ROBOT.limits.joint_speed * ROBOT.dt * ROBOT.limits.stale + 1e-9


@pytest.mark.parametrize("where", ["limp", "running"])
def test_a_body_that_cannot_be_reached_is_an_error_and_ends_the_loop(where):
    def targets(tick):
        body.unreachable = True
        return ROBOT.home

    body, guard, _, loop, _ = make(targets)
    body.unreachable = where == "limp"
    with pytest.raises(BackendError, match="cable"):
        loop.run()
    assert guard.phase is Phase.DAMPED


def test_a_failing_listener_still_leaves_torque_off():
    def broken(record):
        if record.tick == 20:
            raise ValueError("listener")

    body, _, _, loop, _ = make(listeners=(broken,))
    with pytest.raises(ValueError, match="listener"):
        loop.run()
    assert modes(body)[-2:] == [Mode.DAMP, Mode.OFF]


def test_a_record_that_cannot_be_written_ends_the_run_lowered_with_one_event():
    full = []
    body, guard, _, loop, records = make(
        lambda tick: (full.append(1), ROBOT.home)[1], failure=lambda: "disk full: free some space" if full else None
    )
    loop.run()
    events = [event for record in records for event in record.events if event.kind == "record"]
    assert [event.text for event in events] == ["disk full: free some space"]
    assert modes(body)[-1] is Mode.OFF
    assert guard.cause == "record"


def test_one_ctrl_c_lowers_and_a_second_cuts_torque_at_once():
    def targets(tick):
        signal.raise_signal(signal.SIGINT)
        return ROBOT.home

    body, guard, interrupt, loop, records = make(targets)

    def again(record):
        if record.phase is Phase.LOWERING and len(records) > 20:
            signal.raise_signal(signal.SIGINT)

    loop._listeners = (*loop._listeners, again)
    with interrupt:
        loop.run()
    assert interrupt.count == 2
    assert modes(body)[-2:] == [Mode.DAMP, Mode.OFF]
    assert modes(body).count(Mode.DAMP) == 1
    assert guard.cause == "interrupt"
    assert any(event.text == TWICE for record in records for event in record.events)


def test_a_stop_that_is_due_is_heeded_before_the_policy_is_asked_again():
    """A SIGTERM to the process group ends the planner as well: a policy that then fails must not keep a standing robot
    from being lowered."""

    def targets(tick):
        if interrupt.count:
            guard.fault("policy", "the planner process was killed by signal 15")
        return ROBOT.home

    def terminate(record):
        if record.tick == 30:
            signal.raise_signal(signal.SIGTERM)

    _, guard, interrupt, loop, records = make(targets, listeners=(terminate,))
    with interrupt:
        loop.run()
    assert guard.cause == "interrupt"
    assert Phase.LOWERING in {record.phase for record in records}
    assert guard.phase is Phase.DAMPED


def test_a_policy_that_hangs_is_broken_off_by_the_second_ctrl_c():
    def targets(tick):
        signal.setitimer(signal.ITIMER_REAL, 0.05)
        while True:
            signal.pause()

    body, guard, interrupt, loop, _ = make(targets)
    before = signal.signal(signal.SIGALRM, lambda *_: [signal.raise_signal(signal.SIGINT) for _ in range(2)])
    try:
        with interrupt:
            loop.run()
    finally:
        signal.signal(signal.SIGALRM, before)
    assert modes(body)[-2:] == [Mode.DAMP, Mode.OFF]
    assert any(event.text == TWICE for event in guard.events())


def test_the_estimator_never_sees_a_gap_and_the_record_keeps_it():
    body, _, _, loop, records = make(script=[stop_at(60)])
    reads = []

    def spoil(observation):
        reads.append(1)
        return spoiled(observation, [3]) if len(reads) in (1, 2, 30) else observation

    body.spoil = spoil
    loop.run()
    assert [record.state is None for record in records[:4]] == [True, True, False, False]
    assert np.isnan(records[29].observation.position[3])
    assert np.isfinite(records[29].state.position).all()
    assert records[29].phase is Phase.RUNNING

"""The guard's invariants, numbered as in stack/safety/guard.py."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fake_body import FakeBody, StillEstimator, observation, spoiled, tilted
from hypothesis import given, settings
from hypothesis import strategies as st

from servoid.hw.contracts.body import BackendError, Mode
from servoid.hw.robot.description import load_robot
from servoid.hw.robot.legs import Legs
from servoid.stack.estimation.sample_hold import SampleHold
from servoid.stack.safety.guard import DAMP_SECONDS, PATIENCE, Guard
from servoid.stack.safety.lowering import lowered_pose
from servoid.stack.safety.phase import Phase

ROBOT = load_robot("op3")
N = len(ROBOT.names)
LOW, HIGH = ROBOT.lower + ROBOT.limits.margin, ROBOT.upper - ROBOT.limits.margin
STEP = ROBOT.limits.joint_speed * ROBOT.dt


class Rig:
    """A guard over a fake body, ticked by hand."""

    def __init__(self, start=None):
        self.body = FakeBody(ROBOT, start)
        self.guard = Guard(ROBOT, self.body)
        self.hold = SampleHold()
        self.estimator = StillEstimator(ROBOT)
        self.tick = 0
        self.events = []

    def step(self, target=None, ticks=1, spoil=lambda o: o):
        self.tick += ticks
        raw = spoil(observation(ROBOT, round(self.tick * ROBOT.dt * 1e9), self.body.position))
        seen = self.hold.update(raw)
        state = self.estimator.update(seen, self.guard.applied)
        self.guard.begin(self.tick, raw.time_ns)
        command = self.guard.decide(seen, state, target)
        self.guard.send()
        self.events += self.guard.events()
        return command

    def until(self, phase, limit=1000, **kwargs):
        for _ in range(limit):
            if self.guard.phase is phase:
                return self
            self.step(**kwargs)
        raise AssertionError(f"never {phase}, but {self.guard.phase}: {self.events}")

    def running(self):
        self.guard.home(observation(ROBOT, 0, self.body.position))
        self.until(Phase.READY)
        self.guard.start()
        return self

    def kinds(self):
        return [event.kind for event in self.events]


wild = st.floats(allow_nan=True, allow_infinity=True, width=64)
targets = st.lists(wild | st.floats(-3, 3), min_size=N, max_size=N).map(np.array)
proposals = st.lists(
    st.tuples(targets | st.floats(-3, 3).map(lambda x: np.full(N, x)), st.integers(1, 200)), min_size=1, max_size=12
)


@pytest.mark.slow
@settings(max_examples=150, deadline=None)
@given(proposals)
def test_1_2_no_command_leaves_range_or_rate(sequence):
    rig = Rig().running()
    previous, accepted = rig.guard.applied, rig.tick
    for target, ticks in sequence:
        command = rig.step(target, ticks)
        assert np.isfinite(command.position).all()
        if command.mode is not Mode.ACTIVE:
            break
        assert (command.position >= LOW - 1e-9).all()
        assert (command.position <= HIGH + 1e-9).all()
        allowed = STEP * min(rig.tick - accepted, ROBOT.limits.stale)
        assert np.abs(command.position - previous).max() <= allowed + 1e-9
        if np.isfinite(target).all():
            accepted = rig.tick
        previous = command.position


@pytest.mark.slow
@settings(max_examples=50, deadline=None)
@given(st.lists(st.floats(-3, 3), min_size=N, max_size=N), st.lists(st.integers(1, 9), min_size=1, max_size=10))
def test_2_homing_is_slow_from_any_pose_and_any_gaps(start, gaps):
    rig = Rig(np.array(start))
    rig.guard.home(observation(ROBOT, 0, rig.body.position))
    step = ROBOT.limits.homing_speed * ROBOT.dt
    previous = np.array(start)
    for i in range(2000):
        if rig.guard.phase is not Phase.HOMING:
            break
        position = rig.step(ticks=gaps[i % len(gaps)]).position
        assert np.abs(position - previous).max() <= step + 1e-9
        back = np.abs(position - ROBOT.home) <= np.abs(previous - ROBOT.home) + 1e-9
        assert back.all()  # never away from home, so never further out of a range
        previous = position
    assert rig.guard.phase is Phase.READY
    np.testing.assert_allclose(previous, ROBOT.home, atol=1e-9)


def test_3_nothing_is_sent_before_home():
    rig = Rig()
    for _ in range(20):
        rig.step(np.ones(N))
    assert rig.body.sent == []
    assert rig.guard.phase is Phase.LIMP


def test_3_a_target_before_start_moves_nothing():
    rig, untold = Rig(), Rig()
    for one, target in ((rig, np.full(N, 0.1)), (untold, None)):
        one.guard.home(observation(ROBOT, 0, one.body.position))
        for _ in range(50):
            one.step(target)
        assert one.guard.phase is Phase.READY
    np.testing.assert_array_equal(
        [sent.position for sent in rig.body.sent], [sent.position for sent in untold.body.sent]
    )


def test_home_needs_a_sample_of_every_joint():
    rig = Rig()
    rig.guard.home(spoiled(observation(ROBOT, 0, rig.body.position), [11]))
    rig.step()
    assert rig.guard.phase is Phase.FAULT
    assert [event.joint for event in rig.events if event.kind == "stale"] == ["l_knee"]
    assert all(command.mode is not Mode.ACTIVE for command in rig.body.sent)


def test_homing_faults_when_a_joint_does_not_come_along():
    rig = Rig()
    rig.guard.home(observation(ROBOT, 0, rig.body.position))
    stuck = ROBOT.home.copy()
    stuck[10] += 0.6
    rig.until(Phase.FAULT, spoil=lambda o: replace(o, position=stuck))
    assert [event.joint for event in rig.events if event.kind == "homing"] == ["l_hip_pitch"]


@pytest.mark.parametrize("bad", [np.nan, np.inf, -np.inf])
def test_4_non_finite_target_holds_then_damps(bad):
    rig = Rig().running()
    rig.step(ROBOT.home + 0.05)
    held = rig.guard.applied
    target = ROBOT.home.copy()
    target[11] = bad
    for _ in range(PATIENCE - 1):
        command = rig.step(target)
        assert command.mode is Mode.ACTIVE
        np.testing.assert_array_equal(command.position, held)
    assert rig.step(target).mode is Mode.DAMP
    assert rig.guard.phase is Phase.FAULT
    assert {event.joint for event in rig.events if event.kind in ("rejected", "policy")} == {"l_knee"}


def test_4_single_bad_targets_do_not_add_up():
    rig = Rig().running()
    for i in range(20):
        rig.step(np.full(N, np.nan) if i % 2 else ROBOT.home)
    assert rig.guard.phase is Phase.RUNNING


def test_4_target_of_the_wrong_shape_is_a_fault():
    rig = Rig().running()
    assert rig.step(np.zeros(N - 1)).mode is Mode.DAMP


operations = st.sampled_from(["target", "nan", "stop", "fault", "start", "home", "tilt", "blind", "release"])


@pytest.mark.slow
@settings(max_examples=200, deadline=None)
@given(st.booleans(), st.lists(operations, min_size=1, max_size=40))
def test_5_an_ended_guard_never_drives_again(run_first, sequence):
    rig = Rig()
    if run_first:
        rig.running()
    ended = False
    for operation in sequence:
        spoil = lambda o: o  # noqa: E731
        target = ROBOT.home
        try:
            match operation:
                case "stop":
                    rig.guard.stop("interrupt", "Ctrl-C")
                case "fault":
                    rig.guard.fault("servo", "broken")
                case "start":
                    rig.guard.start()
                case "home":
                    rig.guard.home(observation(ROBOT, 0, rig.body.position))
                case "release":
                    rig.guard.release()
                case "nan":
                    target = np.full(N, np.nan)
                case "tilt":
                    spoil = lambda o: tilted(o, 1.5)  # noqa: E731
                case "blind":
                    spoil = lambda o: spoiled(o, [0])  # noqa: E731
        except RuntimeError:
            pass  # out of order: refused
        sent = len(rig.body.sent)
        for _ in range(4):
            rig.step(target, spoil=spoil)
        if ended:
            assert all(command.mode is not Mode.ACTIVE for command in rig.body.sent[sent:])
            assert rig.guard.phase in (Phase.DAMPED, Phase.FAULT)
        ended = rig.guard.phase in (Phase.DAMPED, Phase.FAULT)


def test_5_damped_ends_with_torque_off_and_silence():
    rig = Rig().running()
    rig.guard.fault("servo", "broken")
    for _ in range(round(DAMP_SECONDS * ROBOT.rate)):
        assert rig.step().mode is Mode.DAMP
    assert not rig.guard.off
    assert rig.step().mode is Mode.OFF
    assert rig.guard.off
    sent = len(rig.body.sent)
    rig.step()
    assert len(rig.body.sent) == sent


def test_6_coasts_over_a_gap_and_damps_on_a_longer_one():
    rig = Rig().running()
    for _ in range(ROBOT.limits.stale):
        rig.step(ROBOT.home, spoil=lambda o: spoiled(o, [4]))
    assert rig.guard.phase is Phase.RUNNING
    rig.step(ROBOT.home, spoil=lambda o: spoiled(o, [4]))
    assert rig.guard.phase is Phase.FAULT
    assert [event.joint for event in rig.events if event.kind == "stale"] == ["l_el"]


def test_6_a_gap_that_closes_is_forgiven():
    rig = Rig().running()
    for i in range(40):
        rig.step(ROBOT.home, spoil=(lambda o: spoiled(o, range(N))) if i % 4 else (lambda o: o))
    assert rig.guard.phase is Phase.RUNNING


@pytest.mark.parametrize("change", [{"imu_age": np.asarray(1.0)}, {"angular_velocity": np.full(3, np.nan)}])
def test_6_a_silent_imu_damps(change):
    rig = Rig().running()
    for _ in range(ROBOT.limits.stale + 1):
        rig.step(ROBOT.home, spoil=lambda o: replace(o, **change))
    assert rig.guard.phase is Phase.FAULT
    assert any("IMU" in event.text for event in rig.events)


def test_6_old_samples_that_the_body_reports_itself_damp():
    rig = Rig().running()
    rig.step(ROBOT.home, spoil=lambda o: replace(o, age=np.where(np.arange(N) == 3, 0.1, 0.0)))
    assert [event.joint for event in rig.events if event.kind == "stale"] == ["l_sho_roll"]


def test_6_the_estimated_tilt_counts_where_the_imu_does_not_fuse():
    rig = Rig().running()
    seen = replace(observation(ROBOT, 0, ROBOT.home), orientation=np.full(4, np.nan))
    upright = rig.estimator.update(observation(ROBOT, 0, ROBOT.home), ROBOT.home)
    assert rig.guard.decide(seen, upright, ROBOT.home).mode is Mode.ACTIVE
    lying = replace(upright, gravity=np.array([1.0, 0.0, 0.0]))
    assert rig.guard.decide(seen, lying, ROBOT.home).mode is Mode.DAMP


def test_6_an_estimate_that_is_not_finite_damps():
    rig = Rig().running()
    seen = observation(ROBOT, 0, ROBOT.home)
    lost = replace(rig.estimator.update(seen, ROBOT.home), gravity=np.full(3, np.nan))
    assert rig.guard.decide(seen, lost, ROBOT.home).mode is Mode.DAMP


def test_6_tilt_damps_at_once():
    rig = Rig().running()
    rig.step(ROBOT.home, spoil=lambda o: tilted(o, ROBOT.limits.tilt - 0.02))
    assert rig.guard.phase is Phase.RUNNING
    assert rig.step(ROBOT.home, spoil=lambda o: tilted(o, -ROBOT.limits.tilt - 0.02)).mode is Mode.DAMP
    assert "fall" in rig.kinds()


@pytest.mark.parametrize(("bits", "words"), [(1 << 5, "overload"), (1 << 2 | 1, "overheating"), (1 << 7, "0x80")])
def test_6_servo_errors_are_named(bits, words):
    rig = Rig().running()
    rig.step(ROBOT.home, spoil=lambda o: replace(o, fault=np.where(np.arange(N) == 17, bits, 0)))
    (event,) = [event for event in rig.events if event.kind == "servo"]
    assert event.joint == "r_knee"
    assert words in event.text
    assert rig.guard.phase is Phase.FAULT


def test_release_damps_and_frees_in_two_writes():
    rig = Rig().running()
    sent = len(rig.body.sent)
    rig.guard.release()
    assert [command.mode for command in rig.body.sent[sent:]] == [Mode.DAMP, Mode.OFF]
    rig.guard.release()
    assert len(rig.body.sent) == sent + 2


def test_release_tries_both_writes_and_says_that_it_failed():
    rig = Rig().running()
    tried = []

    def write(command):
        tried.append(command.mode)
        raise BackendError("the cable is out")

    rig.body.write = write
    with pytest.raises(BackendError, match="cable"):
        rig.guard.release()
    assert tried == [Mode.DAMP, Mode.OFF]
    assert not rig.guard.off


def test_a_waist_that_legs_share_stays_as_it_is_while_the_robot_is_lowered():
    """Each leg bent it its own way, and the last one had its will: the robot twisted."""
    heron = load_robot("heron")
    low, legs = lowered_pose(heron), Legs(heron)
    waist = [heron.names.index(name) for name in ("waist_yaw", "waist_roll")]
    np.testing.assert_array_equal(low[waist], heron.home[waist])
    assert -legs.soles(legs.pick(low))[1][..., 2].min() < 0.9 * heron.standing_height


def test_crouch_keeps_the_soles_flat_and_the_base_over_them():
    legs = Legs(ROBOT)
    low = lowered_pose(ROBOT)
    before, _ = legs.soles(legs.pick(ROBOT.home))
    after, corners = legs.soles(legs.pick(low))
    np.testing.assert_allclose(after[:, 1], before[:, 1], atol=1e-4)
    assert (corners[..., 0].min(1) < -0.03).all()  # the base's origin is over the soles, away from their edges
    assert (corners[..., 0].max(1) > 0.03).all()
    assert np.ptp(corners[..., 2]) < np.ptp(legs.soles(legs.pick(ROBOT.home))[1][..., 2]) + 1e-4
    assert -corners[..., 2].min() < 0.75 * ROBOT.standing_height
    assert (low >= LOW).all()
    assert (low <= HIGH).all()
    np.testing.assert_allclose(low[:8], ROBOT.home[:8])

"""The backend on the virtual rig, byte for byte and in its own time: it stands, and faults are absorbed or named."""

from __future__ import annotations

import contextlib
from dataclasses import replace

import numpy as np
import pytest

from servoid.hw.contracts.body import BackendError, Command, Mode, Observation
from servoid.hw.dynamixel.backend import DynamixelBackend, DynamixelSensors
from servoid.hw.dynamixel.motors import DynamixelMotors
from servoid.hw.faults import LATE, TORQUE_LOST, WATCHDOG
from servoid.hw.robot.description import load_robot
from servoid.sim.rig.in_process import InProcessLine
from servoid.sim.rig.rig import Rig
from servoid.sim.rig.wire.faults import Fault

ROBOT = load_robot("op3")
TICK_NS = 20_000_000
STALE = 0.06  # s: three ticks, after which the guard damps
KNEE = ROBOT.names.index("l_knee")


class Standing:
    """A rig that stands at home with torque on."""

    def __init__(self) -> None:
        self.rig = Rig(ROBOT)
        self.line = InProcessLine(self.rig)
        self.backend = DynamixelBackend(ROBOT, port=self.line, clock=self.line)
        self.sensors: DynamixelSensors
        self.motors: DynamixelMotors
        self.sensors, self.motors = self.backend.connect()
        self.run(5)

    def run(self, ticks: int) -> list[Observation]:
        seen = []
        for _ in range(ticks):
            self.line.sleep_until((self.line.now_ns() // TICK_NS + 1) * TICK_NS)
            seen.append(self.sensors.read())
            self.motors.write(Command(ROBOT.home, np.ones(20), Mode.ACTIVE))
        return seen

    def torque(self) -> int:
        return sum(servo.get("torque_enable") for servo in self.rig.servos)


@pytest.fixture
def standing() -> Standing:
    return Standing()


def test_it_connects_as_delivered_stands_and_lets_go(standing: Standing) -> None:
    assert standing.backend.differences == ()
    assert standing.torque() == 20
    o = standing.run(30)[-1]
    assert np.abs(o.position - ROBOT.home).max() < 0.15
    np.testing.assert_allclose(np.linalg.norm(o.specific_force), 9.81, atol=1.0)
    assert o.effort[KNEE] < -0.02 or o.effort[KNEE] > 0.02, "a bent knee that stands carries something"
    assert (o.fault == 0).all()
    goals = [a for a in standing.rig.accepted if a.register == "goal_position"]
    assert len(goals) > 20 * 30
    limits = [(ROBOT.lower[a.joint] - 0.01 <= a.position <= ROBOT.upper[a.joint] + 0.01) for a in goals]
    assert all(limits)
    counters = standing.backend.counters
    assert counters.bad_crc == counters.unexpected == counters.conflicts == counters.babble == 0
    standing.backend.close()
    assert standing.torque() == 0


@pytest.mark.parametrize("kind", ["drop", "corrupt", "truncate", "duplicate", "wrong_id", "late", "split", "garbage"])
def test_what_happens_on_any_bus_is_absorbed(standing: Standing, kind: str) -> None:
    """At 2 % of all answers no joint is ever without a sample for long, and no value is wrong."""
    standing.rig.inject(Fault(kind=kind, at=standing.rig.seconds, probability=0.02))  # type: ignore[arg-type]
    before = standing.run(1)[0].position
    for o in standing.run(60):
        assert o.age.max() < STALE
        assert not o.fault.any()
        off = np.nanmax(np.abs(o.position - before))
        assert off < 0.2, "it stands still: another servo's angle would be far off"
    assert standing.torque() == 20


@pytest.mark.parametrize(
    ("kind", "bits"), [("torque_off", TORQUE_LOST), ("watchdog", WATCHDOG), ("overheating", 4), ("overload", 32)]
)
def test_what_a_servo_keeps_to_itself_is_named(standing: Standing, kind: str, bits: int) -> None:
    standing.rig.inject(Fault(kind=kind, servo="l_knee", at=standing.rig.seconds))  # type: ignore[arg-type]
    faults = [o.fault for o in standing.run(10)]
    first = next(i for i, fault in enumerate(faults) if fault.any())
    assert first <= 7
    assert np.flatnonzero(faults[first]).tolist() == [KNEE]
    assert faults[first][KNEE] & bits


@pytest.mark.parametrize("kind", ["dead", "baud_mismatch", "reboot"])
def test_a_servo_that_goes_silent_is_seen_by_its_age_alone(standing: Standing, kind: str) -> None:
    standing.rig.inject(Fault(kind=kind, servo="l_knee", at=standing.rig.seconds))  # type: ignore[arg-type]
    o = standing.run(6)[-1]
    assert np.flatnonzero(o.age > STALE).tolist() == [KNEE]
    assert np.isnan(o.position[KNEE])
    assert np.isfinite(np.delete(o.position, KNEE)).all()


def test_an_imu_that_dies_is_seen_by_its_age(standing: Standing) -> None:
    standing.rig.inject(Fault(kind="imu_frozen", at=standing.rig.seconds))
    o = standing.run(8)[-1]
    assert o.imu_age > STALE
    assert np.isnan(o.specific_force).all()


@pytest.mark.parametrize("phase", range(0, 16, 3))
def test_an_adapter_that_gathers_bytes_is_named_or_its_samples_are_old(standing: Standing, phase: int) -> None:
    """At 16 ms some ticks have their samples by luck, so that no joint alone is ever old for long."""
    standing.line.sleep_until(standing.line.now_ns() + phase * 1_000_000)
    standing.rig.inject(Fault(kind="batching", at=standing.rig.seconds))
    seen = standing.run(10)
    assert any((o.fault & LATE).all() or o.age.max() > STALE or o.imu_age > STALE for o in seen)
    assert not (seen[0].fault & LATE).any(), "one late answer is an accident"


def test_a_host_that_stops_is_stopped_by_the_watchdog(standing: Standing) -> None:
    """Nobody sends anything any more: within 100 ms every servo has stopped by itself."""
    standing.line.sleep_until(standing.line.now_ns() + 100_000_000)
    assert all(servo.get("bus_watchdog") == 255 for servo in standing.rig.servos)
    o = standing.run(7)[-1]
    assert (o.fault & WATCHDOG).all()


def test_two_runs_are_the_same_bit_for_bit() -> None:
    first, second = (Standing().run(15)[-1] for _ in range(2))
    np.testing.assert_array_equal(first.position, second.position)
    np.testing.assert_array_equal(first.specific_force, second.specific_force)
    assert first.time_ns == second.time_ns


@pytest.mark.parametrize("call", range(0, 60, 3))
def test_an_interrupt_at_any_instant_still_lets_torque_off(standing: Standing, call: int) -> None:
    """Between any two things that the backend does with its port or clock: the next command must get through."""
    left = [call]

    def counted(method):  # type: ignore[no-untyped-def]
        def wrapper(*arguments):  # type: ignore[no-untyped-def]
            left[0] -= 1
            if left[0] == 0:
                raise KeyboardInterrupt
            return method(*arguments)

        return wrapper

    line = standing.line
    methods = {name: getattr(line, name) for name in ("read", "write", "sleep_until")}
    for name, method in methods.items():
        setattr(line, name, counted(method))
    with contextlib.suppress(KeyboardInterrupt):
        standing.run(6)
    for name, method in methods.items():
        setattr(line, name, method)
    standing.motors.write(Command(ROBOT.home, np.ones(20), Mode.DAMP))
    standing.motors.write(Command(ROBOT.home, np.ones(20), Mode.OFF))
    assert standing.torque() == 0


def test_a_geared_joint_is_driven_through_turns_of_its_servo() -> None:
    """In extended position mode, which is written before it is driven, and from wherever the servo counts itself."""
    joints = tuple(
        replace(joint, gear=4.0, range=(-1.5, 1.5), zero=0.3) if joint.name == "head_pan" else joint
        for joint in ROBOT.joints
    )
    robot = replace(ROBOT, joints=joints)
    rig = Rig(robot)
    rig.servos[0].put("operating_mode", 3)  # as it comes from the factory
    line = InProcessLine(rig)
    backend = DynamixelBackend(robot, port=line, clock=line)
    with pytest.raises(BackendError, match="registers differ"):
        backend.connect()
    assert {(d.joint, d.register, d.wanted) for d in backend.differences} == {("head_pan", "operating_mode", 4)}
    sensors, motors = DynamixelBackend(robot, port=line, clock=line, fix=True).connect()
    goal = robot.home.copy()
    for target in (0.0, 1.4, -1.4):
        for _ in range(150 if target else 5):
            line.sleep_until((line.now_ns() // TICK_NS + 1) * TICK_NS)
            seen = sensors.read()
            goal[0] += np.clip(target - goal[0], -0.03, 0.03)
            motors.write(Command(goal, np.ones(20), Mode.ACTIVE))
        assert seen.position[0] == pytest.approx(target, abs=0.05)
    assert abs(float(rig.motors.angle[0])) > 3.2, "more than half a turn of the servo's horn"
    motors.off()

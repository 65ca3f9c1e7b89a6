"""Heat, supply, blocked joints and buttons: named within 10 ticks, gains down first, and then the robot lowered."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from fake_body import FakeBody, StillEstimator, observation

from servoid.hw.contracts.body import Mode, Observation
from servoid.hw.faults import IMU_FROZEN, INPUT_VOLTAGE, STOP_BUTTON, STOP_BUTTON_AGAIN, TORQUE_LOST
from servoid.hw.robot.description import load_robot
from servoid.stack.estimation.sample_hold import SampleHold
from servoid.stack.safety.guard import Guard
from servoid.stack.safety.health import DERATED, LOW_TICKS
from servoid.stack.safety.phase import Phase

ROBOT = load_robot("op3")
N = len(ROBOT.names)
KNEE = ROBOT.names.index("l_knee")
BLOCK = 4  # joints whose slow registers are read in a tick


class Rig:
    """A guard over a body whose temperatures and voltages come in rotation, as from the bus."""

    def __init__(self, gain: float = 1.0) -> None:
        self.body = FakeBody(ROBOT)
        self.guard = Guard(ROBOT, self.body, gain)
        self.hold, self.estimator = SampleHold(), StillEstimator(ROBOT)
        self.tick = 0
        self.events: list = []
        self.temperature, self.voltage = np.full(N, 40.0), np.full(N, 12.0)
        self.fault = np.zeros(N, dtype=int)
        self.stuck: dict[int, float] = {}
        self.change = lambda o: o

    def read(self) -> Observation:
        seen = np.zeros(N, bool)
        start = self.tick * BLOCK % N
        seen[start : start + BLOCK] = True
        position = self.body.position.copy()
        for joint, angle in self.stuck.items():
            position[joint] = angle
        raw = replace(
            observation(ROBOT, round(self.tick * ROBOT.dt * 1e9), position),
            temperature=np.where(seen, self.temperature, np.nan),
            voltage=np.where(seen, self.voltage, np.nan),
            fault=self.fault.copy(),
        )
        return self.change(raw)

    def step(self, ticks: int = 1) -> Rig:
        for _ in range(ticks):
            self.tick += 1
            seen = self.hold.update(self.read())
            state = self.estimator.update(seen, self.guard.applied)
            self.guard.begin(self.tick, seen.time_ns)
            self.guard.decide(seen, state, ROBOT.home)
            self.guard.send()
            self.events += self.guard.events()
        return self

    def running(self) -> Rig:
        self.guard.home(self.read())
        while self.guard.phase is not Phase.READY:
            self.step()
        self.guard.start()
        self.step(10)
        self.events.clear()
        return self

    def ticks_until(self, kind: str, limit: int = 200) -> int:
        for ticks in range(1, limit):
            self.step()
            if any(event.kind == kind for event in self.events):
                return ticks
        raise AssertionError(f"never {kind}: {self.events}")

    def first(self, kind: str):
        return next(event for event in self.events if event.kind == kind)

    @property
    def gain(self) -> np.ndarray:
        return self.body.sent[-1].gain


def test_a_hot_servo_is_softened_alone_then_the_robot_lowered() -> None:
    rig = Rig(gain=0.8).running()
    rig.temperature[KNEE] = 60.5
    assert rig.ticks_until("derated") <= 10
    assert rig.first("derated").joint == "l_knee"
    assert "60 C" in rig.first("derated").text or "61 C" in rig.first("derated").text
    gains = []
    for temperature in np.arange(60.5, 70.0, 0.5):
        rig.temperature[KNEE] = temperature
        rig.step(6)
        gains.append(rig.gain[KNEE])
    assert np.all(np.diff(gains) <= 0)
    assert gains[-1] == pytest.approx(0.8 * DERATED, abs=0.8 * 0.051)
    np.testing.assert_array_equal(np.delete(rig.gain, KNEE), 0.8)
    assert rig.guard.phase is Phase.RUNNING
    rig.temperature[KNEE] = 45.0
    rig.step(10)
    assert rig.gain[KNEE] == gains[-1], "a gain that came up again would swing"
    rig.temperature[KNEE] = 71.0
    assert rig.ticks_until("temperature") <= 10
    assert rig.first("temperature").joint == "l_knee"
    assert rig.guard.phase is Phase.STOPPING
    assert len([event for event in rig.events if event.kind == "derated"]) <= 9, "said once a step, not once a tick"


def test_a_low_supply_softens_everything_and_then_lowers_named_with_the_lowest_servo() -> None:
    rig = Rig().running()
    rig.voltage[:], rig.voltage[KNEE] = 10.2, 10.1
    assert rig.ticks_until("derated") <= 10
    rig.step(10)
    assert DERATED < rig.gain.min() == rig.gain.max() < 1.0
    assert rig.guard.phase is Phase.RUNNING
    rig.voltage[:], rig.voltage[KNEE] = 9.8, 9.7
    assert rig.ticks_until("voltage") <= 10
    event = rig.first("voltage")
    assert event.joint == "l_knee"
    assert "9.7 V at l_knee" in event.text
    assert "charge the battery" in event.text
    assert rig.guard.phase is Phase.STOPPING


def test_a_stumbles_sag_is_no_low_supply() -> None:
    rig = Rig().running()
    for _ in range(10):
        rig.voltage[:] = 9.0
        rig.step(LOW_TICKS - 1)
        rig.voltage[:] = 12.0
        rig.step(10)
    assert rig.guard.phase is Phase.RUNNING
    assert rig.gain.min() == 1.0
    assert rig.events == []


def test_a_supply_that_nobody_measures_and_limits_that_nobody_set_stop_nothing() -> None:
    rig = Rig().running()
    rig.change = lambda o: replace(o, voltage=np.full(N, np.nan), temperature=np.full(N, np.nan))
    rig.step(30)
    bare = replace(ROBOT, limits=replace(ROBOT.limits, derate_temperature=None, voltage=None, derate_voltage=None))
    rig.guard = Guard(bare, rig.body)
    rig.running()
    rig.change = lambda o: o
    rig.voltage[:], rig.temperature[:] = 3.0, 69.0
    rig.step(30)
    assert rig.guard.phase is Phase.RUNNING
    assert rig.gain.min() == 1.0


def test_a_blocked_joint_is_let_go_soft_before_its_servo_shuts_down_and_the_robot_lowered() -> None:
    rig = Rig().running()
    rig.stuck[KNEE] = ROBOT.home[KNEE] - 0.5
    soft = rig.ticks_until("derated")
    assert soft * ROBOT.dt < 0.3
    rig.step()
    servo = ROBOT.servos[KNEE]
    assert rig.gain[KNEE] * servo.stiffness * 0.5 <= DERATED * servo.stall_torque + 1e-9, "no longer at full output"
    lowered = rig.ticks_until("overload")
    assert (soft + lowered) * ROBOT.dt < 0.6
    assert rig.first("overload").joint == "l_knee"
    assert rig.guard.phase is Phase.LOWERING


def test_a_robot_that_is_lowered_for_heat_keeps_its_strength() -> None:
    rig = Rig().running()
    rig.temperature[KNEE] = 75.0
    rig.ticks_until("temperature")
    rig.step(20)
    assert rig.guard.phase is Phase.LOWERING
    np.testing.assert_array_equal(rig.gain, 1.0)


def test_a_robot_that_is_lowered_for_a_low_supply_keeps_its_strength_though_the_supply_recovers() -> None:
    """It does when the motors have less to do, and then all gains would go down in the middle of the crouch."""
    rig = Rig().running()
    rig.voltage[:] = 9.8
    rig.ticks_until("voltage")
    rig.voltage[:] = 10.2
    rig.step(30)
    assert rig.guard.phase is Phase.LOWERING
    np.testing.assert_array_equal(rig.gain, 1.0)


def test_a_joint_that_is_blocked_while_the_robot_comes_to_rest_has_it_lowered_at_once() -> None:
    rig = Rig().running()
    rig.stuck[KNEE] = ROBOT.home[KNEE] - 0.5
    rig.ticks_until("derated")
    rig.guard.stop("interrupt", "Ctrl-C")
    assert rig.guard.phase is Phase.STOPPING
    rig.ticks_until("overload")
    assert rig.guard.phase is Phase.LOWERING


@pytest.mark.parametrize("case", ["sagging", "moving", "for a moment", "soft gains", "hot"])
def test_work_is_not_taken_for_a_block(case: str) -> None:
    rig = Rig(gain=0.4 if case == "soft gains" else 1.0).running()
    if case == "hot":
        rig.temperature[KNEE] = ROBOT.limits.temperature - 0.1
        rig.step(10)
        assert {event.kind for event in rig.events} == {"derated"}
        rig.events.clear()
    rig.stuck[KNEE] = ROBOT.home[KNEE] - (0.25 if case == "sagging" else 0.4)
    if case == "moving":
        rig.change = lambda o: replace(o, velocity=np.full(N, 0.5))
    for _ in range(10):
        rig.step(10)
        if case == "for a moment":
            rig.stuck[KNEE] = ROBOT.home[KNEE]
            rig.step()
            rig.stuck[KNEE] = ROBOT.home[KNEE] - 0.4
    assert rig.guard.phase is Phase.RUNNING
    assert rig.events == []


def test_the_stop_button_lowers_and_pressed_again_damps_at_once() -> None:
    rig = Rig().running()
    rig.fault |= STOP_BUTTON
    rig.step()
    assert rig.guard.phase is Phase.STOPPING
    assert rig.guard.cause == "button"
    assert "stop button" in rig.first("button").text
    rig.step(5)
    assert rig.guard.phase is Phase.STOPPING, "holding it down is not pressing it again"
    assert len([event for event in rig.events if event.kind == "button"]) == 1
    rig.fault |= STOP_BUTTON_AGAIN
    rig.step()
    assert rig.body.sent[-1].mode is Mode.DAMP
    while not rig.guard.off:
        rig.step()


def test_a_button_that_is_down_lets_nothing_begin() -> None:
    rig = Rig()
    rig.fault |= STOP_BUTTON
    rig.guard.home(rig.read())
    rig.step(5)
    assert rig.guard.off
    assert rig.body.sent == []
    assert rig.first("button")


def test_an_input_voltage_error_lowers_and_others_damp_each_servo_named() -> None:
    rig = Rig().running()
    rig.fault[3] = INPUT_VOLTAGE
    rig.step()
    assert rig.guard.phase is Phase.STOPPING
    assert "input voltage" in rig.first("voltage").text
    rig.fault[5] = rig.fault[KNEE] = TORQUE_LOST
    rig.step()
    assert rig.guard.phase is Phase.FAULT
    assert {event.joint for event in rig.events if event.kind == "servo"} == {ROBOT.names[5], "l_knee"}


def test_one_bad_imu_sample_is_forgiven_and_a_dead_imu_named_with_the_reason() -> None:
    def frozen(o: Observation) -> Observation:
        nothing = np.full(3, np.nan)
        return replace(o, fault=o.fault | IMU_FROZEN, angular_velocity=nothing, specific_force=nothing)

    rig = Rig().running()
    rig.change = frozen
    rig.step(2)
    rig.change = lambda o: o
    rig.step(2)
    assert rig.guard.phase is Phase.RUNNING
    rig.change = frozen
    assert rig.ticks_until("stale") <= 10
    assert "IMU" in rig.first("stale").text
    assert "stand still" in rig.first("stale").text
    assert rig.guard.phase is Phase.FAULT

"""A robot that is held in the pose it was found in: what bring-up does before it moves one joint."""

from __future__ import annotations

import numpy as np
import pytest
from fake_body import FakeBody, StillEstimator, observation, spoiled

from hw.hal import Mode
from hw.robot import load_robot
from stack.safety import Guard, Phase

ROBOT = load_robot("op3")
N = len(ROBOT.names)
START = np.linspace(-0.2, 0.2, N)


class Held:
    def __init__(self) -> None:
        self.body = FakeBody(ROBOT, START)
        self.guard = Guard(ROBOT, self.body)
        self.estimator = StillEstimator(ROBOT)
        self.tick = 0
        self.guard.hold(observation(ROBOT, 0, START))

    def step(self, target: np.ndarray | None = None, temperature: float = 30.0) -> None:
        self.tick += 1
        seen = observation(ROBOT, self.tick * 20_000_000, self.body.position)
        seen.temperature[:] = temperature
        self.guard.begin(self.tick, seen.time_ns)
        self.guard.decide(seen, self.estimator.update(seen, self.guard.applied), target)
        self.guard.send()


def test_holding_moves_nothing_and_a_target_waits_for_start() -> None:
    held = Held()
    for _ in range(20):
        held.step(np.zeros(N))
    assert held.guard.phase is Phase.READY
    assert len(held.body.sent) == 20
    for command in held.body.sent:
        np.testing.assert_array_equal(command.position, START)
    held.guard.start()
    held.step(np.zeros(N))
    moved = np.abs(held.body.sent[-1].position - START)
    assert 0.0 < moved.max() <= ROBOT.limits.joint_speed * ROBOT.dt + 1e-9


@pytest.mark.parametrize("running", [False, True])
@pytest.mark.parametrize("why", ["stop", "heat"])
def test_a_held_robot_is_not_lowered(running: bool, why: str) -> None:
    """It hangs on a stand or lies on a table: a crouch would be twenty joints moving that nobody asked to."""
    held = Held()
    held.step()
    if running:
        held.guard.start()
    if why == "stop":
        held.guard.stop("interrupt", "Ctrl-C")
    for _ in range(40):
        held.step(temperature=30.0 if why == "stop" else 90.0)
    assert held.guard.phase is Phase.DAMPED
    assert {command.mode for command in held.body.sent} == {Mode.ACTIVE, Mode.DAMP, Mode.OFF}
    assert held.body.sent[-1].mode is Mode.OFF
    for command in held.body.sent:
        np.testing.assert_array_equal(command.position, START)


def test_holding_needs_a_sample_of_every_joint() -> None:
    guard = Guard(ROBOT, FakeBody(ROBOT))
    guard.hold(spoiled(observation(ROBOT, 0, START), [11]))
    assert guard.phase is Phase.FAULT
    assert any("l_knee" in event.text for event in guard.events())


def test_holding_is_for_a_limp_robot_alone() -> None:
    held = Held()
    with pytest.raises(RuntimeError, match="not limp"):
        held.guard.hold(observation(ROBOT, 0, START))

"""A robot that is held in the pose it was found in: what bring-up does before it moves one joint."""

from __future__ import annotations

import numpy as np
import pytest
from fake_body import FakeBody, StillEstimator, observation, spoiled, tilted

from servoid.hw.contracts.body import Mode
from servoid.hw.robot.description import load_robot
from servoid.stack.safety.guard import Guard
from servoid.stack.safety.phase import Phase

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

    def step(self, target: np.ndarray | None = None, temperature: float = 30.0, tilt: float = 0.0) -> None:
        self.tick += 1
        seen = tilted(observation(ROBOT, self.tick * 20_000_000, self.body.position), tilt)
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


@pytest.mark.parametrize("tilt", [1.6, np.pi])
def test_a_held_robot_may_lie_or_hang_and_still_be_moved(tilt: float) -> None:
    """It was not brought home, so that nobody expects it to be upright; one that was falls at the same tilt."""
    held = Held()
    held.step(tilt=tilt)
    assert held.guard.phase is Phase.READY
    held.guard.start()
    for _ in range(20):
        held.step(np.zeros(N), tilt=tilt)
    assert held.guard.phase is Phase.RUNNING
    assert np.abs(held.body.sent[-1].position - START).max() > 0.0

    home = Guard(ROBOT, FakeBody(ROBOT))
    home.home(observation(ROBOT, 0, ROBOT.home))
    for tick in range(1, 10):
        home.begin(tick, tick * 20_000_000)
        upright = observation(ROBOT, tick * 20_000_000, ROBOT.home)
        home.decide(upright, held.estimator.update(upright, ROBOT.home), None)
    assert home.phase is Phase.READY
    fallen = tilted(upright, tilt)
    home.decide(fallen, held.estimator.update(fallen, ROBOT.home), None)
    assert home.phase is Phase.FAULT


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

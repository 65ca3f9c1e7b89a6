"""The same run on the virtual rig as in simulation: real bytes between, and the robot goes the same way."""

from __future__ import annotations

import signal
from typing import Any

import numpy as np
import pytest

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.world import Truth
from servoid.hw.robot.description import load_robot
from servoid.sim.backend import SimBackend
from servoid.sim.rig.process.backend import VirtualBackend
from servoid.stack.control.base import BasePolicy
from servoid.stack.log.tick import TickRecord
from servoid.stack.runtime.run import RunSettings, run
from servoid.stack.safety.phase import Phase

ROBOT = load_robot()
STRAIGHT = {"vx": "0.1", "vy": "0", "yaw_rate": "0"}


class Watched(VirtualBackend):
    """Notes the servos' torque when the loop has ended, before closing switches anything."""

    torque: tuple[int, ...] = ()

    def close(self) -> None:
        if self._rig is not None:
            self.torque = tuple(servo["torque"] for servo in self.rig.control.servos())
        super().close()


def walk(body: Any, seconds: float) -> tuple[Array, Array]:
    """Joint positions as observed `(ticks, n_joints)` rad and the base's true position `(ticks, 3)` m, of the task."""
    truth: Truth = body.truth
    joints, path = [], []

    def note(record: TickRecord) -> None:
        if record.proposal.instruction is not None:
            joints.append(record.observation.position)
            path.append(truth.position[0].copy())

    result = run(RunSettings("walk", policy="gait", set=STRAIGHT, seconds=seconds), backend=body, on_tick=note)
    assert result.outcome == "succeeded"
    assert result.missed == 0
    return np.array(joints), np.array(path)


@pytest.mark.slow
def test_a_walk_is_that_of_the_simulation_and_repeats_bit_for_bit() -> None:
    """10 s straight ahead. In tight turns soles slip, and there a little noise parts two simulations as well."""
    joints, path = walk(SimBackend(ROBOT), 10.0)
    virtual_joints, virtual_path = walk(VirtualBackend(ROBOT), 10.0)
    apart = np.degrees(np.sqrt(np.mean(np.square(joints - virtual_joints))))
    end = np.linalg.norm((path[-1] - path[0] - virtual_path[-1] + virtual_path[0])[:2])
    print(f"sim against virtual: joints {apart:.3f} degrees RMS, end {end * 1000:.1f} mm of {path[-1, 0]:.2f} m")
    assert 0.0 < apart < 0.1
    assert end < 0.01
    for first, second in zip((virtual_joints, virtual_path), walk(VirtualBackend(ROBOT), 10.0), strict=True):
        np.testing.assert_array_equal(first, second)


@pytest.mark.slow
@pytest.mark.parametrize("policy", ["gait", "expert"])
def test_a_run_ends_damped_and_then_off(policy: str) -> None:
    body, phases = Watched(ROBOT, seed=2), []
    settings = RunSettings("walk", policy=policy, seconds=1.0, seed=2, backend="virtual", set={"push": "0.05"})
    result = run(settings, backend=body, on_tick=lambda record: phases.append((record.phase, record.command.mode.name)))
    assert result.outcome == "succeeded"
    assert phases[-1] == (Phase.DAMPED, "OFF")
    assert phases[-2] == (Phase.DAMPED, "DAMP")
    assert body.torque == (0,) * 20


@pytest.mark.slow
@pytest.mark.parametrize("count", [1, 2])
@pytest.mark.parametrize("tick", [0, 30, 79, 111])
def test_ctrl_c_at_any_phase_ends_with_torque_off(tick: int, count: int) -> None:
    body = Watched(ROBOT)

    def interrupt(record: TickRecord) -> None:
        if record.tick == tick:
            for _ in range(count):
                signal.raise_signal(signal.SIGINT)

    settings = RunSettings("walk", policy="gait", seconds=60.0, backend="virtual")
    result = run(settings, backend=body, on_tick=interrupt)
    assert result.outcome == "interrupted"
    assert body.torque == (0,) * 20


@pytest.mark.slow
def test_a_policy_that_hangs_after_a_push_is_broken_off_with_torque_off() -> None:
    """The second Ctrl-C is an exception in the middle of a tick: no request to the rig may be cut in half by it."""

    class Hangs(BasePolicy):
        def act(self, *_: Any) -> Array:
            signal.raise_signal(signal.SIGINT)
            signal.raise_signal(signal.SIGINT)
            raise AssertionError("not broken off")

    body = Watched(ROBOT)
    settings = RunSettings("walk", seconds=60.0, backend="virtual", set={"push": "0.1", "push_every": "0.02"})
    result = run(settings, backend=body, policy=Hangs())
    assert result.outcome == "interrupted"
    assert body.torque == (0,) * 20


@pytest.mark.slow
def test_an_exception_in_a_run_ends_the_rig_too() -> None:
    body = Watched(ROBOT)
    processes = []

    def broken(record: TickRecord) -> None:
        processes.append(body.rig.process)
        if record.tick == 40:
            raise ZeroDivisionError

    with pytest.raises(ZeroDivisionError):
        run(RunSettings("walk", policy="gait", backend="virtual"), backend=body, on_tick=broken)
    assert body.torque == (0,) * 20
    assert processes[0].poll() is not None

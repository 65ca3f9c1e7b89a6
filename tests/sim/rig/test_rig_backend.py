"""The virtual rig as a body: nothing before it is connected, everything over bytes, and nothing left behind."""

from __future__ import annotations

import subprocess
from dataclasses import replace
from typing import Any

import numpy as np
import pytest

from servoid.hw.contracts.body import BackendError, Command, Mode
from servoid.hw.contracts.world import Scene
from servoid.hw.dynamixel.backend import DynamixelBackend
from servoid.hw.robot.description import load_robot
from servoid.sim.backend import SimBackend
from servoid.sim.rig.process import control
from servoid.sim.rig.process.backend import VirtualBackend
from servoid.sim.rig.process.control import RigProcess

ROBOT = load_robot()
TICK = 20_000_000  # ns
HOME = Command(ROBOT.home, np.ones(20), Mode.ACTIVE)


def ended(rig: RigProcess) -> bool:
    return rig.process.poll() is not None


@pytest.mark.slow
def test_it_stands_is_pushed_and_ends_with_torque_off_and_without_a_process() -> None:
    body = VirtualBackend(ROBOT, seed=3)
    assert body.clock.now_ns() == 0
    with pytest.raises(BackendError, match="not connected"):
        _ = body.truth.position
    sensors, motors = body.connect()
    rig = body.rig
    with pytest.raises(BackendError, match="already connected"):
        body.connect()
    start = body.clock.now_ns()
    assert start % TICK == 0, "ticks fall on steps of physics"
    np.testing.assert_allclose(sensors.read().position, ROBOT.home, atol=0.01)
    assert not any(servo["torque"] for servo in rig.control.servos()), "connecting switches nothing on"
    for tick in range(1, 26):
        body.clock.sleep_until(start + tick * TICK)
        sensors.read()
        motors.write(HOME)
    assert not body.truth.fallen[0]
    assert body.truth.position[0, 2] == pytest.approx(ROBOT.standing_height, abs=0.01)

    before = body.truth.velocity[0, :2].copy()
    body.push(np.array([0.1, -0.2]))
    np.testing.assert_allclose(body.truth.velocity[0, :2] - before, [0.1, -0.2], atol=0.01)

    seen: list[dict[str, Any]] = []
    hardware = body._body
    assert hardware is not None
    close = hardware.close

    def watched() -> None:
        close()
        seen.extend(rig.control.servos())

    hardware.close = watched  # type: ignore[method-assign]
    last = body.clock.now_ns()
    body.close()
    assert [servo["torque"] for servo in seen] == [0] * 20
    assert ended(rig)
    assert body.clock.now_ns() >= last, "time does not go back"
    body.close()  # twice is no harm


@pytest.mark.slow
def test_the_truth_is_asked_for_once_an_instant(monkeypatch: pytest.MonkeyPatch) -> None:
    body = VirtualBackend(ROBOT)
    body.connect()
    asked, call = [], body.rig.control.call

    def counted(op: str, **arguments: Any) -> dict[str, Any]:
        asked.append(op)
        return call(op, **arguments)

    monkeypatch.setattr(body.rig.control, "call", counted)
    for _ in range(3):
        _ = body.truth.position, body.truth.yaw, body.truth.fallen
    body.clock.sleep_until(body.clock.now_ns() + TICK)
    _ = body.truth.gravity, body.truth.velocity
    body.push(np.zeros(2))
    _ = body.truth.angular_velocity
    body.close()
    assert [op for op in asked if op in ("truth", "push")] == ["truth", "truth", "push", "truth"]


@pytest.mark.slow
@pytest.mark.parametrize(("ahead", "touching"), [(0.10, True), (0.30, False)])
def test_whether_it_touches_the_scene_is_told_by_the_rig(ahead: float, touching: bool) -> None:
    body = VirtualBackend(ROBOT, scene=Scene(np.array([[ahead, 0.0, 0.05]]), np.zeros((0, 4))))
    body.connect()
    assert body.truth.touching.tolist() == [touching]
    body.close()


@pytest.mark.slow
def test_a_seed_draws_the_same_robot_as_in_simulation() -> None:
    """What a robot shows of its draw: battery voltage, the gyro's bias about the vertical, how late its head obeys."""
    turned = ROBOT.home.copy()
    turned[ROBOT.names.index("head_pan")] = 0.5
    shown = []
    for make in (SimBackend, VirtualBackend):
        for seed in (3, 4):
            body = make(ROBOT, seed=seed, randomise=True)
            sensors, motors = body.connect()
            start, seen, head = body.clock.now_ns(), [], []
            for tick in range(1, 86):
                body.clock.sleep_until(start + tick * TICK)
                seen.append(sensors.read())
                head.append(body.truth.joints[0, ROBOT.names.index("head_pan")])
                motors.write(HOME if tick <= 80 else replace(HOME, position=turned))
            turn = np.mean([o.angular_velocity[2] for o in seen[50:80]])
            shown.append((float(np.nanmedian(seen[79].voltage)), float(turn), *head[80:]))
            body.close()
    sim, other_sim, virtual, other_virtual = shown
    assert virtual == pytest.approx(sim, abs=0.002)
    assert other_virtual == pytest.approx(other_sim, abs=0.002)
    assert abs(sim[0] - other_sim[0]) > 0.05
    assert abs(sim[1] - other_sim[1]) > 0.01


def test_a_rig_that_does_not_fit_is_refused_and_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    """A wrong board: connecting fails, and no process is left."""
    rigs: list[RigProcess] = []
    start = RigProcess.__init__

    def other(self: RigProcess, robot: Any, **options: Any) -> None:
        rigs.append(self)
        start(self, replace(ROBOT, bus=replace(ROBOT.bus, board_id=201)), **options)

    monkeypatch.setattr(RigProcess, "__init__", other)
    body = VirtualBackend(ROBOT)
    with pytest.raises(BackendError, match="200"):
        body.connect()
    (rig,) = rigs
    assert ended(rig)


@pytest.mark.parametrize("where", ["process", "connect"])
def test_ctrl_c_while_it_starts_leaves_no_process(monkeypatch: pytest.MonkeyPatch, where: str) -> None:
    started: list[subprocess.Popen[bytes]] = []
    popen = subprocess.Popen

    def noted(*arguments: Any, **options: Any) -> Any:
        started.append(popen(*arguments, **options))
        return started[-1]

    def interrupted(*_: Any) -> Any:
        raise KeyboardInterrupt

    monkeypatch.setattr(subprocess, "Popen", noted)
    if where == "process":
        monkeypatch.setattr(RigProcess, "_first_line", interrupted)
    else:
        monkeypatch.setattr(DynamixelBackend, "connect", interrupted)
    with pytest.raises(KeyboardInterrupt):
        VirtualBackend(ROBOT).connect()
    (process,) = started
    assert process.poll() is not None


def test_a_rig_that_hangs_while_it_starts_is_given_up_and_ended(monkeypatch: pytest.MonkeyPatch) -> None:
    started: list[subprocess.Popen[bytes]] = []
    popen = subprocess.Popen

    def hangs(command: list[str], **options: Any) -> Any:
        started.append(popen(["sleep", "60"], **options))
        return started[-1]

    monkeypatch.setattr(subprocess, "Popen", hangs)
    monkeypatch.setattr(control, "_START_SECONDS", 0.2)
    with pytest.raises(BackendError, match=r"did not start: nothing was heard of it for 0\.2 s"):
        RigProcess(ROBOT)
    assert started[0].poll() is not None


def test_a_rig_that_died_is_a_bus_error_and_closing_still_ends_it() -> None:
    body = VirtualBackend(ROBOT)
    sensors, motors = body.connect()
    sensors.read()
    motors.write(HOME)
    rig = body.rig
    rig.process.kill()
    rig.process.wait()
    with pytest.raises(BackendError):
        body.clock.sleep_until(body.clock.now_ns() + TICK)
    with pytest.raises(BackendError):
        body.close()
    body.close()
    assert ended(rig)

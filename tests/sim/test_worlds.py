"""Worlds do not depend on each other, their sensors err as the robot's file says, and their motors obey late."""

from __future__ import annotations

from dataclasses import asdict, replace
from pathlib import Path
from typing import Any

import numpy as np
import pytest
import yaml

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Command, Mode, Observation
from servoid.hw.contracts.world import Start
from servoid.hw.robot.description import Robot, load_robot
from servoid.sim.model import TIMESTEP, build
from servoid.sim.randomise import (
    BACKLASH,
    COMMAND_DELAY,
    FRICTION,
    IMU_TILT,
    LATENCY,
    MASS,
    STIFFNESS,
    VOLTAGE,
    ZERO,
    draw,
)
from servoid.sim.truth import SimulatedTruth
from servoid.sim.worlds import Worlds

ROBOT = load_robot()
PLAIN_IMU = replace(ROBOT, imu=replace(ROBOT.imu, average=0.0))  # no filter: single samples can be compared
ONES = np.ones(len(ROBOT.joints))
HEAD, ARM, KNEE = (ROBOT.names.index(name) for name in ("head_pan", "l_sho_roll", "l_knee"))


def make(n: int = 1, robot: Any = ROBOT, **changes: Any) -> Worlds:
    """Worlds of nominal robots with some of what is drawn replaced."""
    return started(Worlds(robot, n, threads=1, drawn=lambda *args: replace(draw(*args), **changes)))


def started(worlds: Worlds, seeds: Any = None, joints: Any = None) -> Worlds:
    seeds = range(worlds.n) if seeds is None else seeds
    worlds.reset(np.arange(worlds.n), [np.random.default_rng([9, seed]) for seed in seeds], Start(joints=joints))
    return worlds


def hold(position: Any, mode: Mode = Mode.ACTIVE) -> Command:
    return Command(np.asarray(position, dtype=float), ONES, mode)


def pan(angle: float) -> Command:
    position = ROBOT.home.copy()
    position[HEAD] = angle
    return hold(position)


def trajectory(n: int, seeds: list[int], world: int, threads: int) -> list[bytes]:
    """Everything that world `world` shows over 80 ticks (more than a refill of noise) of its own commands."""
    worlds = started(Worlds(ROBOT, n, threads=threads, randomise=0.5), seeds)
    rngs, seen = [np.random.default_rng(seed) for seed in seeds], []
    for _ in range(80):
        worlds.step(hold(ROBOT.home + np.array([0.1 * rng.standard_normal(20) for rng in rngs])))
        o = worlds.observe()
        for value in (o.position, o.velocity, o.effort, o.angular_velocity, o.specific_force, worlds.truth.qpos):
            seen.append(value[world].tobytes())
    return seen


def test_a_world_is_the_same_whatever_its_number_neighbours_and_threads() -> None:
    alone = trajectory(1, [2], 0, 1)
    assert alone == trajectory(5, [0, 1, 2, 3, 4], 2, 1)
    assert alone == trajectory(3, [2, 7, 8], 0, 2)
    assert alone != trajectory(1, [3], 0, 1)


def test_resetting_a_world_leaves_the_others_alone() -> None:
    disturbed, quiet = (started(Worlds(ROBOT, 2, threads=1, randomise=1.0)) for _ in range(2))
    for tick in range(12):
        if tick == 6:
            disturbed.reset(np.array([0]), [np.random.default_rng(5)])
        for worlds in (disturbed, quiet):
            worlds.step(pan(0.2))
        ours, theirs = disturbed.observe(), quiet.observe()
        np.testing.assert_array_equal(ours.position[1], theirs.position[1])
        np.testing.assert_array_equal(ours.specific_force[1], theirs.specific_force[1])
    assert disturbed.ticks.tolist() == [6, 12]
    assert not np.array_equal(disturbed.truth.qpos[0], quiet.truth.qpos[0])


def test_sensors_have_the_resolution_of_the_servo() -> None:
    worlds = started(Worlds(ROBOT, 2, threads=1, randomise=1.0))
    servo = ROBOT.servos[0]
    for _ in range(5):
        worlds.step(pan(0.4))
    o = worlds.observe()
    for value, unit in (
        (o.position, 2 * np.pi / 4096),
        (o.velocity, 0.229 * 2 * np.pi / 60),
        (o.effort, 0.00269 * servo.torque_per_ampere),
        (o.voltage, 0.1),
    ):
        steps = value / unit
        np.testing.assert_allclose(steps, np.round(steps), atol=1e-4)
        assert np.abs(steps).max() > 1
    assert np.isnan(o.temperature).all()
    assert np.isnan(o.orientation).all()  # never invented


@pytest.mark.parametrize("ticks_late", [0, 1])
def test_joints_are_seen_late_by_the_latency(ticks_late: int) -> None:
    worlds = make(joint_latency=ticks_late * ROBOT.dt)
    moved, tick_angle = [worlds.truth.joints.copy()], 2 * np.pi / 4096
    for tick in range(1, 12):
        worlds.step(pan(0.5))
        moved.append(worlds.truth.joints.copy())
        late = moved[tick - ticks_late]
        np.testing.assert_allclose(worlds.observe().position, np.round(late / tick_angle) * tick_angle, atol=1e-12)
    assert moved[-1][0, HEAD] > 0.2  # it did move
    assert worlds.observe().age == pytest.approx(ticks_late * ROBOT.dt)


def test_the_imu_is_seen_late_by_its_own_latency() -> None:
    robot = replace(PLAIN_IMU, imu=replace(PLAIN_IMU.imu, gyro_noise=0.0))
    worlds = make(robot=robot, imu_latency=ROBOT.dt + TIMESTEP, gyro_bias=np.zeros(3))
    rates = [worlds.batch.sensordata[:, :3].copy()]
    for tick in range(1, 12):
        worlds.step(hold(ROBOT.home, Mode.OFF))  # it collapses: the base turns
        rates.append(worlds.batch.sensordata[:, :3].copy())
        np.testing.assert_allclose(worlds.observe().angular_velocity, rates[tick - 1], atol=1e-12)
    assert np.abs(rates[-1]).max() > 0.05


def test_gyro_noise_and_bias_are_those_of_the_robots_file() -> None:
    worlds = started(Worlds(PLAIN_IMU, 6, threads=1))
    left = []
    for _ in range(256):
        worlds.step(hold(ROBOT.home))
        left.append(worlds.observe().angular_velocity - worlds.batch.sensordata[:, :3])
    left = np.array(left)
    assert left.std(0) == pytest.approx(0.003, rel=0.2)
    assert left.std(0).mean() == pytest.approx(0.003, rel=0.05)
    bias = left.mean(0)
    np.testing.assert_allclose(bias, [body.gyro_bias for body in worlds.bodies if body], atol=8e-4)
    assert (np.abs(bias) < 0.0205).all()
    assert np.ptp(bias) > 0.01  # no two IMUs are alike
    assert np.abs((left[1:] * left[:-1]).mean(0) - bias**2).max() < 3e-6  # white: what is left of ticks is unrelated


def test_the_imus_filter_averages_its_samples() -> None:
    robot = replace(ROBOT, imu=replace(ROBOT.imu, gyro_noise=0.0))
    worlds = make(robot=robot, imu_latency=TIMESTEP, gyro_bias=np.zeros(3))
    worlds.step(hold(ROBOT.home, Mode.OFF))
    worlds.step(hold(ROBOT.home, Mode.OFF))
    samples = worlds._fresh["sensordata"][0, :, :3]  # of one tick, which the filter spans
    assert np.ptp(samples, axis=0).max() > 1e-3
    np.testing.assert_allclose(worlds.observe().angular_velocity[0], samples.mean(0), atol=1e-12)


def test_reading_twice_within_a_tick_is_the_same_and_the_next_tick_is_not() -> None:
    worlds = started(Worlds(ROBOT, 1, threads=1))
    for _ in range(66):  # over the refill of the noise
        first, second = worlds.observe(), worlds.observe()
        np.testing.assert_array_equal(first.specific_force, second.specific_force)
        worlds.step(hold(ROBOT.home))
        assert not np.array_equal(worlds.observe().specific_force, first.specific_force)


def test_backlash_is_a_play_between_joint_and_encoder() -> None:
    play, tick_angle = 0.05, 2 * np.pi / 4096
    worlds = make(joint_latency=0.0, backlash=play)

    def error(goal: float) -> float:
        for _ in range(12):
            worlds.step(pan(goal))
            seen = worlds.observe().position[0, HEAD]
            assert abs(seen - worlds.truth.joints[0, HEAD]) <= play / 2 + tick_angle
        return float(seen - worlds.truth.joints[0, HEAD])

    assert error(0.5) == pytest.approx(-play / 2, abs=tick_angle)  # the encoder lags behind on the way up ...
    assert error(-0.5) == pytest.approx(play / 2, abs=tick_angle)  # ... and on the way down


def test_zero_offsets_cancel_between_what_is_measured_and_commanded() -> None:
    zero = np.zeros(20)
    zero[HEAD] = 0.03
    worlds = make(zero=zero)
    assert worlds.observe().position[0, HEAD] == pytest.approx(0.0, abs=2e-3)  # at home, by its own encoder
    for _ in range(40):
        worlds.step(pan(0.3))
    assert worlds.observe().position[0, HEAD] == pytest.approx(0.3, abs=0.015)  # the rest is friction
    assert worlds.observe().position[0, HEAD] - worlds.truth.joints[0, HEAD] == pytest.approx(0.03, abs=2e-3)


def first_torque(worlds: Worlds) -> float:
    """Time from the write of a goal to the first torque towards it [s]."""
    for _ in range(3):
        worlds.step(hold(ROBOT.home))
    forces = []
    for _ in range(6):
        worlds.step(pan(0.3))
        forces += list(worlds._fresh["actuator_force"][0, :, HEAD])
    return int(np.argmax(np.array(forces) > 1.0)) * TIMESTEP


@pytest.mark.parametrize("delay", [0.008, 0.020, 0.028, 0.040])
def test_commands_act_after_the_delay(delay: float) -> None:
    assert first_torque(make(command_delay=delay)) == pytest.approx(delay)


def with_servos(folder: Path, **changes: Any) -> Robot:
    """The robot with servos of the user's own."""
    robot = Path(ROBOT.mjcf).with_suffix(".yaml").read_text().replace("mjcf: op3.xml", f"mjcf: {ROBOT.mjcf}")
    (folder / "servo.yaml").write_text(yaml.safe_dump(asdict(replace(ROBOT.servos[0], **changes))))
    limits = [line for line in robot.splitlines(True) if "voltage: 10" not in line]  # of a supply of its own
    (folder / "own.yaml").write_text("".join(limits).replace("xm430-w350", "servo.yaml"))
    return load_robot(folder / "own.yaml")


def test_a_slow_servo_of_the_users_own_is_not_sped_up(tmp_path: Path) -> None:
    robot = with_servos(tmp_path, command_delay=0.080, position_latency=0.060)
    worlds = started(Worlds(robot, 1, threads=1))
    assert first_torque(worlds) == pytest.approx(0.080)
    moved = []
    for _ in range(6):
        worlds.step(pan(-0.5))
        moved.append(worlds.truth.joints[0, HEAD])
    assert worlds.observe().position[0, HEAD] == pytest.approx(moved[-4], abs=1e-3)


def test_a_rate_that_the_physics_cannot_keep_is_refused() -> None:
    with pytest.raises(ConfigError, match="60 does not divide"):
        Worlds(replace(ROBOT, rate=60), 1)


def test_damped_motors_brake_and_motors_off_are_free() -> None:
    bent = {}  # the left knee, by the weight of the body, after half a second
    for mode in Mode:
        worlds = started(Worlds(ROBOT, 1, threads=1))
        for _ in range(25):
            worlds.step(hold(ROBOT.home, mode))
        bent[mode] = float(worlds.truth.joints[0, KNEE] - ROBOT.home[KNEE])
    assert bent[Mode.OFF] > 1.5
    assert 0.2 < bent[Mode.DAMP] < 0.7  # it goes down, slowly
    assert bent[Mode.ACTIVE] < 0.1


def test_gain_and_supply_scale_stiffness_together() -> None:
    """The firmware turns an error into a share of the supply: less voltage is a softer joint."""

    def torque(gain: float, **changes: Any) -> float:
        worlds = make(command_delay=0.0, **changes)
        worlds.step(Command(pan(0.05).position, gain * ONES, Mode.ACTIVE))
        return float(worlds._fresh["actuator_force"][0, 0, HEAD])

    assert torque(1.0) == pytest.approx(0.05 * 9.4, rel=1e-3)
    assert torque(0.5) == pytest.approx(0.5 * torque(1.0), rel=1e-3)
    assert torque(1.0, voltage=11.0) == pytest.approx(11 / 12 * torque(1.0), rel=1e-3)
    assert torque(1.0, stiffness=18.8) == pytest.approx(2 * torque(1.0), rel=1e-3)


def synthetic_truth(height: float, tilt: float) -> SimulatedTruth:
    model = build(ROBOT)
    qpos, qvel = np.zeros((1, model.nq)), np.zeros((1, model.nv))
    qpos[0, 2], qpos[0, 3:7] = height, [np.cos(tilt / 2), np.sin(tilt / 2), 0, 0]
    return SimulatedTruth(model, ROBOT, qpos, qvel, np.zeros((1, model.nsensordata)))  # in the air: no contacts


def test_fallen_by_height_and_by_tilt() -> None:
    standing = ROBOT.standing_height
    assert not synthetic_truth(0.61 * standing, 0.0).fallen[0]
    assert synthetic_truth(0.59 * standing, 0.0).fallen[0]
    assert not synthetic_truth(standing, np.deg2rad(59)).fallen[0]
    assert synthetic_truth(standing, np.deg2rad(61)).fallen[0]
    assert synthetic_truth(standing, np.deg2rad(-61)).fallen[0]


def test_fallen_by_touching_the_ground_with_anything_but_the_feet() -> None:
    worlds = started(Worlds(ROBOT, 2, threads=1))
    for _ in range(5):
        worlds.step(hold(ROBOT.home))
    assert (worlds.truth.foot_force > 5).all()
    assert not worlds.truth.fallen.any()
    # On its side in the air, then low enough that the stretched arm is in the ground.
    roll = np.deg2rad(-50)
    worlds.truth.qpos[:, 3:7] = np.cos(roll / 2), np.sin(roll / 2), 0, 0
    worlds.truth.qpos[:, 2] = 0.6, 0.16
    worlds.truth.qpos[:, 7 + ARM] = 0.0
    worlds.batch.forward(np.arange(2))
    assert worlds.truth.position[1, 2] > 0.6 * ROBOT.standing_height
    assert worlds.truth.fallen.tolist() == [False, True]


def test_a_push_changes_the_velocity_in_the_world_frame() -> None:
    worlds = started(Worlds(ROBOT, 2, threads=1))
    half = np.pi / 4  # facing left: what pushes along x comes from its left side
    worlds.truth.qpos[:, 3:7] = np.cos(half), 0, 0, np.sin(half)
    worlds.push(np.array([[0.3, 0.0], [0.0, 0.0]]))
    np.testing.assert_allclose(worlds.truth.velocity[0], [0.0, -0.3, 0.0], atol=1e-12)
    assert not worlds.truth.velocity[1].any()
    worlds.step(hold(ROBOT.home))
    assert worlds.truth.position[0, 0] > 0.002 > abs(worlds.truth.position[1, 0])


def test_friction_is_that_of_the_body() -> None:
    def slid(friction: float) -> float:
        worlds = make(friction=friction)
        start = worlds.truth.foot_position[0, :, 0].copy()
        worlds.push(np.array([[0.6, 0.0]]))
        for _ in range(8):
            worlds.step(hold(ROBOT.home))
        return float((worlds.truth.foot_position[0, :, 0] - start).mean())

    assert slid(0.05) > 3 * slid(1.2)


def test_randomised_robots_are_drawn_inside_the_ranges() -> None:
    rng = np.random.default_rng(0)
    bodies = [draw(rng, ROBOT, 21, True) for _ in range(300)]
    for name, (low, high) in {
        "stiffness": STIFFNESS,
        "voltage": VOLTAGE,
        "friction": FRICTION,
        "mass": MASS,
        "command_delay": COMMAND_DELAY,
        "joint_latency": LATENCY,
        "imu_latency": LATENCY,
        "zero": (-ZERO, ZERO),
        "imu_tilt": (-IMU_TILT, IMU_TILT),
        "gyro_bias": (-0.02, 0.02),
    }.items():
        values = np.array([getattr(body, name) for body in bodies])
        assert low <= values.min() < low + 0.05 * (high - low), name  # the whole range, and nothing else
        assert high - 0.05 * (high - low) < values.max() <= high, name
    assert STIFFNESS == (5.0, 19.0)
    assert COMMAND_DELAY == (0.008, 0.040)
    assert {body.backlash for body in bodies} == {BACKLASH}


def test_another_servo_is_randomised_about_its_own_values(tmp_path: Path) -> None:
    """The ranges are an XM430's: a small servo of 7.4 V, or a slow one, would be drawn as none that there is."""
    own = {"stiffness": 4.7, "voltage": 6.0, "command_delay": 0.060, "position_latency": 0.012}
    robot = with_servos(tmp_path, **own, voltage_range=(5.0, 9.0))
    theirs, ours = (draw(np.random.default_rng(7), r, 21, True) for r in (ROBOT, robot))
    factors = {"stiffness": 0.5, "voltage": 0.5, "command_delay": 3.0, "joint_latency": 3.0, "imu_latency": 1.0}
    for name, factor in factors.items():
        assert getattr(ours, name) == pytest.approx(factor * getattr(theirs, name)), name
    worlds = started(Worlds(robot, 20, threads=1, randomise=1.0))
    delays = np.array([body.command_delay for body in worlds.bodies if body])
    assert delays.max() > 0.1
    moved = []
    for _ in range(8):
        worlds.step(pan(0.3))
        moved.append(np.abs(worlds._fresh["actuator_force"][:, :, HEAD]).max(-1) > 0.5)
    ticks = np.argmax(moved, 0)
    np.testing.assert_array_equal(ticks, np.floor(np.ceil(delays / TIMESTEP) * TIMESTEP / ROBOT.dt + 1e-6))


def test_nominal_robots_are_nominal_but_for_the_imus_bias() -> None:
    a, b = (draw(np.random.default_rng(seed), ROBOT, 21, False) for seed in (0, 1))
    assert (a.stiffness, a.voltage, a.friction, a.command_delay) == (9.4, 12.0, 0.8, 0.020)
    assert (a.mass == 1).all()
    assert not a.zero.any()
    assert not a.imu_tilt.any()
    assert a.backlash == 0.0
    assert not np.array_equal(a.gyro_bias, b.gyro_bias)


def test_the_share_of_randomised_episodes_and_their_masses() -> None:
    worlds = started(Worlds(ROBOT, 100, threads=1, randomise=0.3))
    randomised = np.array([body is not None and body.backlash > 0 for body in worlds.bodies])
    assert 15 <= randomised.sum() <= 45
    masses = worlds._mass.sum(-1)
    np.testing.assert_allclose(masses[~randomised], 3.147, atol=1e-3)
    assert (np.abs(masses[randomised] - 3.147) > 1e-3).all()


def test_an_observation_is_not_changed_by_what_comes_after() -> None:
    worlds = started(Worlds(ROBOT, 1, threads=1))
    o: Observation = worlds.observe()
    before = {name: np.copy(getattr(o, name)) for name in ("position", "velocity", "effort", "specific_force", "age")}
    for _ in range(5):
        worlds.step(pan(0.5))
        worlds.observe()
    for name, value in before.items():
        np.testing.assert_array_equal(getattr(o, name), value)

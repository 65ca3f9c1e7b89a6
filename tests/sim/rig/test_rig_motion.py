"""Bytes that move physics: the same servo as in simulation, and what the firmware's other modes do."""

from __future__ import annotations

import math

import mujoco
import numpy as np
import pytest
from rig_host import BOARD, Host

from servoid.hw.contracts.body import Array, Command, Mode
from servoid.hw.dynamixel.protocol import codec
from servoid.hw.dynamixel.protocol.tables import table
from servoid.hw.imu.mounting import Mounting
from servoid.hw.robot.description import Robot
from servoid.hw.robot.legs import Legs
from servoid.sim.rig.rig import Rig
from servoid.sim.rig.servo.board import VirtualBoard
from servoid.sim.rig.servo.plant import Plant
from servoid.sim.worlds import Worlds

PAN = 19  # the head: it turns freely while the robot is held
TICK = 2 * math.pi / 4096


def ticks(joints: Array) -> list[int]:
    return [2048 + round(float(angle) / TICK) for angle in joints]


def test_the_rig_moves_as_the_simulated_body_does(host: Host, robot: Robot) -> None:
    """Squats and arm swings on the ground: goals as bytes against the simulated backend's own world."""
    bend = {"l_knee": 2, "r_knee": -2, "l_hip_pitch": -1, "r_hip_pitch": 1, "l_ank_pitch": 1, "r_ank_pitch": -1}

    def goal(tick: int) -> Array:
        pose, phase = robot.home.copy(), 2 * math.pi * tick * robot.dt
        for name, sign in bend.items():
            pose[robot.names.index(name)] += 0.08 * sign * (1 - math.cos(phase))
        pose[robot.names.index("l_sho_pitch")] += 0.6 * math.sin(phase)
        return pose

    n, period = 100, round(robot.dt * 1e9)
    worlds = Worlds(robot, 1, threads=1)
    worlds.reset(np.array([0]), [np.random.default_rng([0, 0])])
    rig = host.rig
    rig.auto_release = False
    host.write_all("goal_position", ticks(robot.home))
    host.write_all("torque_enable", [1] * len(host.ids))
    rig.advance(-(-rig.now_ns // period) * period)
    rig.place(robot.home)
    rig.plant.release()
    start, apart = rig.now_ns, []
    for tick in range(n):
        host.ask(codec.sync_read(host.ids, 126, 10, fast=True), 0.0024)
        host.write_all("goal_position", ticks(goal(tick)), 0.0)
        rig.advance(start + (tick + 1) * period)
        worlds.step(Command(goal(tick)[None], np.ones((1, len(robot.joints))), Mode.ACTIVE))
        apart.append(rig.plant.truth.joints[0] - worlds.truth.joints[0])
    assert np.degrees(np.sqrt(np.mean(np.square(apart)))) < 0.1
    assert np.abs(rig.plant.truth.position - worlds.truth.position).max() < 0.002
    assert not rig.plant.truth.fallen[0]


def test_torque_on_everywhere_puts_the_robot_on_its_feet(host: Host) -> None:
    plant = host.rig.plant
    assert plant.held
    host.torque_on(host.ids[:-1])
    host.wait(0.1)
    assert plant.held
    before = plant.data.qpos[2]
    host.torque_on(host.ids[-1:])
    host.wait(0.5)
    assert not plant.held
    assert plant.truth.foot_force.sum() == pytest.approx(3.147 * 9.81, rel=0.2)
    assert plant.data.qpos[2] < before - 0.03
    host.write_all("torque_enable", [0] * 20)
    host.wait(1.5)
    assert plant.truth.fallen[0], "without torque it collapses"


def test_a_robot_is_put_with_its_soles_on_the_floor_whatever_its_encoders_say(robot: Robot) -> None:
    """Its zeros are off: standing by its encoders it would begin above the floor or in it, and tilted."""
    plant, legs = Plant(robot), Legs(robot)
    for seed in range(5):
        plant.reset(seed, randomise=True)
        plant.release()
        true = plant.data.qpos[plant._qpos]
        turn = np.zeros(9)
        mujoco.mju_quat2Mat(turn, plant.data.qpos[3:7])
        corners = legs.soles(legs.pick(true))[1] @ turn.reshape(3, 3).T + plant.data.qpos[:3]
        assert corners[..., 2].min() == pytest.approx(0.0, abs=1e-4)
        assert np.ptp(corners[0, :, 2]) < 1e-4, "the first foot is flat"


def test_a_limp_joint_of_a_held_robot_keeps_its_pose(host: Host) -> None:
    before = host.rig.plant.joints.copy()
    host.torque_on([PAN])
    host.write(PAN, "goal_position", 2400)
    host.wait(1.0)
    moved = np.abs(host.rig.plant.joints - before)
    assert moved[0] == pytest.approx(352 * TICK, abs=0.03)
    assert moved[1:].max() == 0.0


def test_velocity_mode_reaches_and_holds_a_speed(host: Host) -> None:
    host.write(PAN, "operating_mode", 1)
    host.torque_on([])
    host.write(PAN, "torque_enable", 1)
    host.write(PAN, "goal_velocity", -60)
    host.wait(1.0)
    assert host.read(PAN, "present_velocity") == pytest.approx(-60, abs=4)
    host.write(PAN, "goal_velocity", 0)
    host.wait(1.0)
    assert abs(host.read(PAN, "present_velocity")) <= 2


def test_velocity_mode_speeds_up_as_its_profile_says(host: Host) -> None:
    """5 units are 1.87 rad/s2. It moves beside servos in position mode, whose profile is another matter."""
    rad = 0.229 * 2 * math.pi / 60
    host.write(PAN, "operating_mode", 1)
    host.write(PAN, "profile_acceleration", 5)
    host.write(PAN, "torque_enable", 1)
    host.write(PAN, "goal_velocity", round(2.0 / rad))
    host.wait(0.5)
    assert 0.4 < host.read(PAN, "present_velocity") * rad < 1.0, "friction is still to be overcome"
    assert host.read(PAN, "velocity_trajectory") * rad == pytest.approx(0.94, abs=0.1)
    host.wait(1.0)
    assert host.read(PAN, "present_velocity") * rad == pytest.approx(2.0, abs=0.1)


def test_pwm_mode_drives_in_proportion_to_the_duty(host: Host) -> None:
    host.write(PAN, "operating_mode", 16)
    host.write(PAN, "torque_enable", 1)
    speeds = []
    for duty in (885, 442):
        host.write(PAN, "goal_pwm", duty)
        host.wait(0.5)
        assert host.read(PAN, "present_pwm") == duty
        speeds.append(host.read(PAN, "present_velocity") * 0.229 * 2 * math.pi / 60)
    friction = 0.105 / 2.95 * 4.55  # rad/s that friction costs
    assert speeds[0] == pytest.approx(4.55 - friction, abs=0.15)
    assert speeds[1] == pytest.approx(4.55 / 2 - friction, abs=0.15)


def test_current_mode_gives_torque_and_its_limit_bounds_position_mode(host: Host) -> None:
    host.write(PAN, "operating_mode", 0)
    host.write(PAN, "torque_enable", 1)
    host.write(PAN, "goal_current", 100)
    host.wait(0.008)  # after that the light head is soon as fast as the battery can turn it
    assert host.read(PAN, "present_current") == pytest.approx(100, abs=6)
    host.write(PAN, "torque_enable", 0)
    host.write(PAN, "operating_mode", 5)
    host.write(PAN, "torque_enable", 1)
    host.write(PAN, "goal_current", 50)
    host.write(PAN, "goal_position", host.read(PAN, "present_position") + 1500)
    currents = []
    for _ in range(30):
        host.wait(0.01)
        currents.append(abs(host.read(PAN, "present_current")))
    assert 40 <= max(currents) <= 56


def test_profiles_by_velocity_and_by_time(host: Host) -> None:
    host.torque_on([PAN])
    host.write(PAN, "profile_velocity", 30)
    host.write(PAN, "profile_acceleration", 5)
    host.write(PAN, "goal_position", 2548)
    host.wait(0.3)
    assert 15 <= host.read(PAN, "present_velocity") <= 34
    assert host.read(PAN, "moving") == 1
    assert host.read(PAN, "moving_status") & 1 == 0
    host.wait(1.7)
    assert host.read(PAN, "position_trajectory") == 2548
    assert host.read(PAN, "moving_status") & 1 == 1
    host.write(PAN, "torque_enable", 0)
    host.write(PAN, "drive_mode", 4)
    host.torque_on([PAN])
    host.write(PAN, "profile_velocity", 1000)  # ms
    host.write(PAN, "profile_acceleration", 200)
    host.write(PAN, "goal_position", 2048)
    host.wait(0.85)
    assert host.read(PAN, "position_trajectory") > 2060
    host.wait(0.25)
    assert host.read(PAN, "position_trajectory") == 2048


def test_an_integral_gain_removes_what_friction_leaves(host: Host) -> None:
    host.write(PAN, "position_p_gain", 200)
    host.torque_on([PAN])
    host.write(PAN, "goal_position", 2200)
    host.wait(2.0)
    left = 2200 - host.read(PAN, "present_position")
    host.write(PAN, "position_i_gain", 100)
    host.wait(3.0)
    assert left > 10
    assert abs(2200 - host.read(PAN, "present_position")) < left / 2


def test_gains_at_zero_brake_and_torque_off_does_not(host: Host) -> None:
    """Damping is the motor's own back-EMF; a joint without torque turns on."""
    kept = []
    for torque in (1, 0):
        host.rig.reset(0)
        host.start()
        host.write(PAN, "position_p_gain", 0)
        host.write(PAN, "torque_enable", torque)
        host.rig.plant.release()
        host.rig.plant.data.qvel[6] = 3.0
        host.wait(0.04)
        kept.append(host.rig.plant.joint_speed[0] / 3.0)
    assert abs(kept[0]) < 0.05
    assert 0.3 < kept[1] < 0.7


def test_a_stalled_servo_heats_up_and_reports_overload(host: Host, robot: Robot) -> None:
    knee = robot.joints[robot.names.index("l_knee")].id
    firmware = host.rig.motors.firmware
    host.rig.auto_release = False
    host.torque_on(host.ids)
    host.rig.plant.release()
    cold = firmware.winding.copy()
    host.write_all("goal_position", [2048] * 20)
    host.wait(0.5)
    assert host.rig.motors.supply < 12.0, "the battery sags"
    assert firmware.winding.max() > cold.max()
    index = robot.names.index("l_knee")
    for _ in range(600):  # a stall: full voltage on a joint that does not turn
        firmware.duty[:] = 0.0
        firmware.duty[index] = 1.0
        torque = np.zeros(20)
        torque[index] = 2.95
        firmware.settle(torque, np.zeros(20), 12.0)
    host.wait(0.01)
    assert host.read(knee, "hardware_error_status") & 32
    assert host.read(knee, "torque_enable") == 0
    assert host.read(knee, "present_temperature") > 25 + 2


def test_the_board_measures_what_the_body_does(host: Host, rig: Rig) -> None:
    opencr = table("opencr")

    def read(name: str) -> float:
        item = opencr.item(name)
        return item.decode(host.one(codec.read(BOARD, item.address, item.width)).data) * item.scale

    force = np.array([read(f"acceleration_{axis}") for axis in "xyz"])
    expected = rig.robot.imu.signs * -rig.plant.truth.gravity[0] * 9.81
    assert force == pytest.approx(expected, abs=0.5)
    assert read("present_input_voltage") == pytest.approx(12.0, abs=0.1)
    rig.plant.release()
    rig.plant.data.qvel[5] = 1.5  # a turn about the vertical
    host.wait(0.004)
    samples = []
    for _ in range(4):
        host.wait(0.004)
        samples.append(read("gyro_z"))
    assert max(samples) > 0.3
    rig.board.buttons = 2
    assert read("button") == 2


def test_an_imu_is_read_in_the_axes_of_its_mounting(rig: Rig, robot: Robot) -> None:
    """The registers of this robot's board are those of a real one: x and y negated. Mounted on its side, they turn."""
    assert robot.imu.signs == (-1.0, -1.0, 1.0)
    boards = {
        "plain": VirtualBoard(rig.motors, {}, lambda on: None),
        "real": rig.board,
        "side": VirtualBoard(rig.motors, {}, lambda on: None, Mounting(angles=(math.pi / 2, 0.0, 0.0))),
    }
    registers = {}
    for name, board in boards.items():
        board.refresh(0)
        registers[name] = [board.get(f"acceleration_{axis}") for axis in "xyz"]
    x, y, z = registers["plain"]
    assert abs(x) > 10
    assert abs(y) > 10
    assert z > 16000
    assert registers["real"] == [-x, -y, z]
    assert registers["side"] == [x, z, -y]


def test_a_frozen_imu_repeats_itself_and_a_living_one_never_does(host: Host, rig: Rig) -> None:
    def sample() -> bytes:
        host.wait(0.02)
        return host.one(codec.read(BOARD, 32, 12)).data

    assert len({sample() for _ in range(5)}) == 5
    rig.board.imu_frozen = True
    assert len({sample() for _ in range(5)}) == 1

"""Several models of servos, and gears, on one robot: each joint has its own stiffness, delay, supply and friction."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servoid.hw.config import CONFIGS, ConfigError
from servoid.hw.contracts.body import Command, Mode
from servoid.hw.dynamixel.protocol.tables import table
from servoid.hw.dynamixel.protocol.units import Units
from servoid.hw.robot.description import Robot, load_robot
from servoid.sim.randomise import draw
from servoid.sim.rig.in_process import InProcessBackend
from servoid.sim.rig.rig import Rig
from servoid.sim.worlds import Worlds

OP3 = load_robot()
SLOW, OTHER = OP3.names.index("head_tilt"), OP3.names.index("head_pan")


def mixed(folder: Path, gear: float = 1.0, **changes: float) -> Robot:
    """The OP3 with another servo at its head's tilt, the second joint."""
    text = (CONFIGS / "servos" / "xm430-w350.yaml").read_text().splitlines()
    rows = [row for row in text if row.split(":")[0] not in changes]
    (folder / "own.yaml").write_text("\n".join([*rows, *(f"{key}: {value}" for key, value in changes.items())]))
    joints = [*OP3.joints]
    joints[SLOW] = replace(joints[SLOW], servo=str(folder / "own.yaml"), gear=gear)
    return replace(OP3, joints=tuple(joints))


def angles(robot: Robot, ticks: int = 15) -> np.ndarray:
    """What the head's joints read, `(ticks, n_joints)`, after a step of their goals."""
    worlds = Worlds(robot, 1, threads=1)
    worlds.reset(np.array([0]), [np.random.default_rng(0)])
    goal = robot.home.copy()
    goal[[SLOW, OTHER]] += 0.3
    read = []
    for _ in range(ticks):
        worlds.step(Command(goal[None], np.ones((1, len(goal))), Mode.ACTIVE))
        read.append(worlds.observe().position[0])
    return np.array(read)


def test_a_servo_with_a_longer_delay_moves_later_than_its_neighbours(tmp_path: Path) -> None:
    """One delay was drawn for a robot, and other servos were refused."""
    before, after = angles(OP3), angles(mixed(tmp_path, command_delay=0.06))
    moved = [np.flatnonzero(np.abs(read[:, SLOW] - read[0, SLOW]) > 0.01)[0] for read in (before, after)]
    assert moved[1] == moved[0] + 2
    np.testing.assert_allclose(after[:, OTHER], before[:, OTHER], atol=0.01)


def test_a_servo_that_reports_late_is_read_late(tmp_path: Path) -> None:
    before, after = angles(OP3), angles(mixed(tmp_path, position_latency=0.024))
    np.testing.assert_allclose(after[6:, SLOW], before[5:-1, SLOW], atol=0.01)
    worlds = Worlds(mixed(tmp_path, position_latency=0.024), 1, threads=1)
    worlds.reset(np.array([0]), [np.random.default_rng(0)])
    assert worlds.observe().age[0, [OTHER, SLOW]] == pytest.approx([0.004, 0.024])


def test_a_servo_of_another_voltage_has_a_supply_of_its_own(tmp_path: Path) -> None:
    robot = mixed(tmp_path, voltage=5.0, voltage_range="[4.0, 6.0]")
    worlds = Worlds(robot, 1, threads=1)
    worlds.reset(np.array([0]), [np.random.default_rng(0)])
    assert worlds.observe().voltage[0, [OTHER, SLOW]] == pytest.approx([12.0, 5.0])
    np.testing.assert_allclose(angles(robot)[-1], angles(OP3)[-1], atol=0.01)
    with pytest.raises(ConfigError, match="its servos are for 5 to 12 V, and a virtual rig has one supply"):
        Rig(robot)


def test_a_gear_is_stronger_and_slower_and_reads_finer(tmp_path: Path) -> None:
    bare, geared = OP3.servos[SLOW], mixed(tmp_path, gear=2.0).servos[SLOW]
    assert (geared.stall_torque, geared.no_load_speed) == (2 * bare.stall_torque, bare.no_load_speed / 2)
    assert (geared.stiffness, geared.armature) == (4 * bare.stiffness, 4 * bare.armature)
    robot = mixed(tmp_path, gear=2.0)
    units = Units(robot, [table(1020)] * len(robot.joints))
    pose = robot.home + 0.1
    goals = units.goal(pose)
    np.testing.assert_allclose(units.position(goals), pose, atol=1e-3)
    plain = Units(OP3, [table(1020)] * len(robot.joints)).goal(pose)
    assert goals[SLOW] - 2048 == pytest.approx(2 * (plain[SLOW] - 2048), abs=1)


def test_a_geared_joint_of_a_virtual_rig_goes_where_it_is_told(tmp_path: Path) -> None:
    """Its servo turns further than the joint, and its registers count its own turns."""
    robot = mixed(tmp_path, gear=1.5)
    body = InProcessBackend(Rig(robot))
    sensors, motors = body.connect()
    goal = robot.home.copy()
    for tick in range(40):
        goal[[SLOW, OTHER]] = robot.home[[SLOW, OTHER]] + min(0.02 * tick, 0.3)
        motors.write(Command(goal, np.ones(len(goal)), Mode.ACTIVE))
        body.clock.sleep_until(body.clock.now_ns() + 20_000_000)
        seen = sensors.read()
    assert seen.position[[SLOW, OTHER]] == pytest.approx(goal[[SLOW, OTHER]], abs=0.03)
    assert body.rig.plant.joints[[SLOW, OTHER]] == pytest.approx(seen.position[[SLOW, OTHER]], abs=0.005)
    body.close()


@pytest.mark.parametrize(("value", "said"), [("0", "must be positive, not 0"), ("-2", "must be positive, not -2")])
def test_a_gear_that_cannot_be_is_refused(tmp_path: Path, value: str, said: str) -> None:
    text = (CONFIGS / "robots" / "op3.yaml").read_text()
    (tmp_path / "op3.yaml").write_text(text.replace("{name: head_pan,", f"{{name: head_pan, gear: {value},"))
    with pytest.raises(ConfigError, match=rf"joints\[0\].gear: {said}"):
        load_robot(tmp_path / "op3.yaml")


def test_friction_of_the_floor_and_the_supply_are_the_robots_files() -> None:
    """They were constants, so that nobody could see how a robot does on a slippery floor or a low battery."""
    own = replace(OP3, floor_friction=0.35, bus=replace(OP3.bus, supply_voltage=10.8))
    body = draw(np.random.default_rng(3), own, 5, False)
    assert (body.friction, body.voltage) == (0.35, 10.8)
    drawn, before = (draw(np.random.default_rng(3), robot, 5, True) for robot in (own, OP3))
    assert drawn.friction / before.friction == pytest.approx(0.35 / 0.8)
    assert drawn.voltage / before.voltage == pytest.approx(0.9)

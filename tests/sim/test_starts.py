"""Bodies begin where and how they are told: lying, thrown, turned, in mid stride."""

from __future__ import annotations

from dataclasses import replace

import mujoco
import numpy as np
import pytest

from servoid.hw.contracts.body import Command, Mode
from servoid.hw.contracts.world import Scene, Start
from servoid.hw.geometry import headed, up_vector
from servoid.hw.robot.description import load_robot
from servoid.policy.references.gait import Gait
from servoid.sim.ground import Ground
from servoid.sim.model import FLOOR, build
from servoid.sim.worlds import Worlds
from servoid.stack.control.fleet import Fleet

ROBOT = load_robot()
H = np.sqrt(0.5)
# On its feet, back, face, left side, head; and askew.
LYING = np.array([[1, 0, 0, 0], [H, 0, -H, 0], [H, 0, H, 0], [H, -H, 0, 0], [0, 1, 0, 0], [0.8, 0.36, 0.48, 0.0]])


def begun(start: Start, n: int, randomise: float = 0.0) -> Worlds:
    worlds = Worlds(ROBOT, n, threads=1, randomise=randomise)
    worlds.reset(np.arange(n), [np.random.default_rng([7, i]) for i in range(n)], start)
    return worlds


def hold(worlds: Worlds, ticks: int) -> None:
    for _ in range(ticks):
        worlds.step(Command(ROBOT.home, np.ones(len(ROBOT.home)), Mode.ACTIVE))


def deepest(worlds: Worlds, world: int) -> float:
    """How far the body is above the ground [m]: below zero where it is in it."""
    model = worlds.model
    data = mujoco.MjData(model)
    data.qpos[:] = worlds.truth.qpos[world]
    mujoco.mj_forward(model, data)
    floor, way = model.geom(FLOOR).id, np.zeros(6)
    own = [i for i in range(model.ngeom) if i != floor and (model.geom_conaffinity[i] & 1)]
    return min(mujoco.mj_geomDistance(model, data, floor, i, 1.0, way) for i in own)


def test_a_lying_robot_touches_the_ground_and_is_not_in_it() -> None:
    """In the ground it would be thrown out of it, and in the air it would fall."""
    worlds = begun(Start(orientation=LYING), len(LYING), randomise=1.0)
    for i in range(len(LYING)):
        assert deepest(worlds, i) == pytest.approx(0.0, abs=1e-6), i
    before = worlds.truth.position.copy()
    hold(worlds, 5)
    assert (worlds.truth.position[:, 2] - before[:, 2] < 0.01).all()  # nothing jumps up
    assert worlds.truth.fallen[1:5].all()


def test_every_shape_is_put_down_by_its_lowest_point() -> None:
    shapes = {
        "sphere": 'size="0.1"', "capsule": 'size="0.03 0.1"', "cylinder": 'size="0.05 0.1"',
        "box": 'size="0.1 0.05 0.02"', "ellipsoid": 'size="0.1 0.05 0.02"', "mesh": 'mesh="wedge"',
    }  # fmt: skip
    turn = LYING[5] / np.linalg.norm(LYING[5])
    for shape, size in shapes.items():
        model = mujoco.MjModel.from_xml_string(
            f"""<mujoco><asset><mesh name="wedge" vertex="0 0 0 .1 0 0 0 .1 0 0 0 .1 .1 .1 .02"/></asset><worldbody>
            <geom name="{FLOOR}" type="plane" size="9 9 1"/><body pos="0 0 1"><freejoint/>
            <geom type="{shape}" {size} pos="0.02 0.01 0.03" euler="20 30 40" mass="1"/></body></worldbody></mujoco>"""
        )
        data = mujoco.MjData(model)
        data.qpos[3:7] = turn
        data.qpos[2] = Ground(model).height(data.qpos.copy())
        mujoco.mj_forward(model, data)
        apart = mujoco.mj_geomDistance(model, data, 0, 1, 1.0, np.zeros(6))
        assert apart == pytest.approx(0.0, abs=2e-5 if shape == "mesh" else 1e-6), shape


def test_a_thrown_robot_flies_as_it_was_thrown() -> None:
    start = Start(
        position=np.array([[1.0, 2.0, 0.6]] * 2),
        orientation=np.stack([LYING[0], headed(LYING[0], np.array(0.5))]),
        velocity=np.array([[0.4, 0.0, 1.0], [0.0, 0.3, 1.0]]),
        angular_velocity=np.array([[0.0, 0.0, 3.0], [0.0, 0.0, 0.0]]),
    )
    worlds = begun(start, 2)
    np.testing.assert_allclose(worlds.truth.orientation, start.orientation)
    assert worlds.observe().angular_velocity[0, 2] == pytest.approx(3.0, abs=0.05)  # its gyro knows already
    hold(worlds, 5)
    np.testing.assert_allclose(worlds.truth.position[0, :2], [1.04, 2.0], atol=5e-3)
    np.testing.assert_allclose(worlds.truth.position[1, :2], [1.0, 2.03], atol=5e-3)
    np.testing.assert_allclose(worlds.truth.position[:, 2], 0.6 + 0.1 - 9.81 * 0.1**2 / 2, atol=8e-3)
    assert worlds.truth.yaw == pytest.approx([0.3, 0.5], abs=0.02)


def test_in_mid_stride_the_joints_go_on() -> None:
    """A start along a motion at rest would be a stumble."""
    gait = Gait(ROBOT, (3,))
    gait.command(np.array([0.3, 0.0, 0.0]))
    for _ in range(61):
        gait.advance()
    frames = gait.frames(np.array([0]))
    start = Start(
        joints=frames.position[:, 0],
        joint_velocity=frames.joint_velocity[:, 0],
        position=np.array([[0.0, 0.0, np.nan], [0.5, 0.0, np.nan], [0.0, 0.0, 0.3]]),
        heading=np.array([0.0, 1.0, 0.0]),
        velocity=np.tile([0.3, 0.0, 0.0], (3, 1)),
    )
    worlds = begun(start, 3)
    np.testing.assert_allclose(worlds.truth.joints, start.joints)
    np.testing.assert_allclose(worlds.truth.joint_velocity, start.joint_velocity)
    np.testing.assert_allclose(worlds.observe().velocity, start.joint_velocity, atol=0.1)
    assert worlds.truth.yaw == pytest.approx([0.0, 1.0, 0.0], abs=1e-9)
    standing = worlds.truth.foot_position[:2, :, 2].min(-1)
    assert standing == pytest.approx([0.0, 0.0], abs=5e-3)
    assert worlds.truth.position[2, 2] == 0.3


def test_without_a_start_it_stands_as_ever() -> None:
    plain, told = begun(Start(), 1), begun(Start(position=np.array([[0.0, 0.0, np.nan]]), heading=np.zeros(1)), 1)
    np.testing.assert_array_equal(plain.truth.qpos, told.truth.qpos)
    assert plain.truth.position[0, 2] == pytest.approx(ROBOT.standing_height, abs=1e-3)


def test_the_estimator_begins_with_any_robot() -> None:
    """It finds which way is up, wherever that is, and is never lost in a value that is no number."""
    fleet, n = Fleet(ROBOT, len(LYING), None, randomise=1.0, seed=3, threads=1), len(LYING)
    start = Start(
        orientation=LYING,
        joint_velocity=np.random.default_rng(0).normal(0, 1, (n, len(ROBOT.home))),
        velocity=np.tile([0.5, 0.0, 0.0], (n, 1)),
    )
    fleet.reset(np.ones(n, bool), start)
    for tick in range(50):
        state = fleet.observe()
        if tick == 0:
            np.testing.assert_allclose(-state.gravity, up_vector(LYING), atol=0.1)
        for name in ("orientation", "gravity", "yaw", "angular_velocity", "velocity", "displacement", "contact"):
            assert np.isfinite(getattr(state, name)).all(), name
        fleet.step(ROBOT.home)
    where = np.arange(n) == 2  # and one that begins anew leaves the others alone
    before = fleet.truth.qpos.copy()
    fleet.reset(where, replace(start, position=np.tile([0.0, 0.0, 1.0], (n, 1))))
    assert fleet.truth.position[2, 2] == 1.0
    np.testing.assert_array_equal(fleet.truth.qpos[~where], before[~where])


def test_the_ground_is_found_in_a_world_of_several_robots() -> None:
    others = Scene(np.zeros((0, 3)), np.zeros((0, 4)), robots=np.array([[1.0, 0.0, 0.0, 0.0, 0.0]]))
    for q in LYING:
        qpos = np.concatenate([[0.0, 0.0, 9.0], q, ROBOT.home])
        assert Ground(build(ROBOT, others)).height(qpos) == Ground(build(ROBOT)).height(qpos)

"""What a task puts into the world: it stands or rolls there, is felt and seen, and changes nothing else."""

from __future__ import annotations

import os
import subprocess
import sys
from dataclasses import replace
from pathlib import Path

import numpy as np
import pytest

from servoid.hw.contracts.body import Array, Command, Mode
from servoid.hw.contracts.control import State
from servoid.hw.contracts.world import Scene
from servoid.hw.robot.description import Robot, load_robot
from servoid.sim.backend import SimBackend
from servoid.sim.marks import Frame
from servoid.sim.model import build
from servoid.sim.render import render
from servoid.sim.rig.servo.plant import Plant
from servoid.sim.scene import from_plain, plain, robot_bodies

NOTHING = np.zeros((0, 3)), np.zeros((0, 4))
TICK = 20_000_000


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot()


def state(x: float, y: float, yaw: float) -> State:
    """What an estimator believes."""
    n = np.zeros(20)
    return State(
        0, np.array([1.0, 0, 0, 0]), np.array([0, 0, -1.0]), np.array(yaw), np.zeros(3), np.zeros(3),
        np.array([x, y, 0.26]), n, n, np.ones(2),
    )  # fmt: skip


def stand(body: SimBackend, robot: Robot, ticks: int) -> list[Array]:
    """Hold the home pose; what the sensors said meanwhile."""
    sensors, motors = body.connect()
    motors.write(Command(robot.home, np.ones(len(robot.joints)), Mode.ACTIVE))
    seen = []
    for tick in range(1, ticks + 1):
        body.clock.sleep_until(tick * TICK)
        seen.append(sensors.read().position)
    return seen


def test_the_world_without_a_scene_and_with_one_far_away_are_the_same(robot: Robot) -> None:
    """The scene adds neither a joint, nor a draw, nor a sensor before the robot's."""
    far = Scene(np.array([[50.0, 0.0, 0.1]]), np.array([[60.0, 0.0, 0.1, 0.5]]), np.array([55.0, 0.0]))
    for randomise in (False, True):
        plainly = SimBackend(robot, seed=5, randomise=randomise)
        furnished = SimBackend(robot, seed=5, randomise=randomise, scene=far)
        for a, b in zip(stand(plainly, robot, 40), stand(furnished, robot, 40), strict=True):
            np.testing.assert_allclose(a, b, atol=2e-3)  # a tick of the encoder: sums differ in their last bits
        np.testing.assert_allclose(plainly.qpos, furnished.qpos, atol=1e-6)
    assert robot_bodies(build(robot, far)) == build(robot).nbody
    assert build(robot, Scene(*NOTHING)).nsensordata == build(robot).nsensordata


def test_a_pillar_that_is_touched_is_felt_by_the_truth_alone(robot: Robot) -> None:
    near = SimBackend(robot, scene=Scene(np.array([[0.10, 0.0, 0.05]]), np.zeros((0, 4))))
    far = SimBackend(robot, scene=Scene(np.array([[0.30, 0.0, 0.05]]), np.zeros((0, 4))))
    assert near.truth.touching.tolist() == [True]
    assert far.truth.touching.tolist() == [False]
    assert SimBackend(robot).truth.touching.tolist() == [False]


def test_a_sphere_rolls_to_the_robot_and_touches_it(robot: Robot) -> None:
    body = SimBackend(robot, scene=Scene(np.zeros((0, 3)), np.array([[0.5, 0.0, 0.1, 1.0]])))
    assert body.stage is not None
    sensors, motors = body.connect()
    motors.write(Command(robot.home, np.ones(len(robot.joints)), Mode.ACTIVE))
    places, touched = [], []
    for tick in range(1, 21):
        places.append(body.stage.look(state(0, 0, 0)).obstacles[0, 0])
        body.clock.sleep_until(tick * TICK)
        touched.append(bool(body.truth.touching[0]))
    np.testing.assert_allclose(-np.diff(places)[:10], 1.0 * robot.dt, atol=1e-3)  # 1 m/s
    assert not any(touched[:10])
    assert any(touched[10:])
    assert sensors.read().position.shape == (20,)


def test_a_touch_that_is_over_before_the_tick_is_counts(robot: Robot) -> None:
    """Torn away from a pillar, the robot touches it at the first of a tick's substeps alone."""
    scene = Scene(np.array([[0.10, 0.0, 0.05]]), np.zeros((0, 4)))
    body = SimBackend(robot, scene=scene)
    body.push(np.array([-3.0, 0.0]))
    seen = []
    for tick in range(1, 4):
        body.clock.sleep_until(tick * TICK)
        seen.append(bool(body.truth.touching[0]))
    assert (body._worlds._fresh["sensordata"][0, :, -1] == 0).all()
    assert seen == [True, False, False]

    plant = Plant(robot)
    plant.furnish(scene)
    plant.release()
    assert plant.truth.touching[0]
    plant.push(np.array([-3.0, 0.0]))
    seen = []
    for _ in range(10):
        plant.step(np.zeros(20), np.zeros(20, bool), 12.0)
        seen.append((plant.data.sensordata[-1] > 0, bool(plant.truth.touching[0]), bool(plant.touches[0])))
    assert not seen[4][0]
    assert [touching for _, *touching in seen[4::5]] == [[True, True], [False, False]]


def test_what_is_seen_is_right_relative_to_the_robot_wherever_it_believes_to_be(robot: Robot) -> None:
    scene = Scene(np.array([[1.0, 0.5, 0.05]]), np.zeros((0, 4)), np.array([2.0, 0.0]))
    body = SimBackend(robot, scene=scene)  # truly at the origin, facing x
    lost = body.stage.look(state(3.0, 4.0, np.pi / 2))
    np.testing.assert_allclose(lost.obstacles, [[3.0 - 0.5, 4.0 + 1.0, 0.05]], atol=1e-9)
    np.testing.assert_allclose(lost.goal, [3.0, 6.0], atol=1e-9)
    assert (lost.source, lost.age) == ("scene", 0.0)


def test_a_scene_survives_its_way_to_a_rig() -> None:
    scene = Scene(np.array([[1.0, 0.5, 0.05]]), np.zeros((0, 4)), np.array([2.0, 0.0]))
    back = from_plain(plain(scene))
    np.testing.assert_array_equal(back.pillars, scene.pillars)
    np.testing.assert_array_equal(back.goal, scene.goal)
    assert back.spheres.shape == (0, 4)
    with pytest.raises(ValueError, match="has one robot"):  # whoever waits for the others would wait for ever
        plain(replace(scene, robots=np.zeros((1, 5))))


@pytest.mark.slow
def test_pillars_and_spheres_are_drawn() -> None:
    """In a process of its own: MuJoCo chooses how to draw when it is first imported."""
    here = Path(__file__)
    found = os.pathsep.join([str(here.parents[2] / "src"), str(here.parent)])
    environment = os.environ | {"MUJOCO_GL": "egl", "PYTHONPATH": found}
    command = [sys.executable, "-c", "import test_scene; test_scene.draw()"]
    done = subprocess.run(command, env=environment, capture_output=True, text=True)
    assert done.returncode == 0, done.stderr


def draw() -> None:
    """Check pictures with and without a scene."""
    robot, upright = load_robot(), np.array([1.0, 0, 0, 0])
    bare = Frame(np.array([0, 0, 0.26]), upright, robot.home)
    stood = Frame(bare.place, upright, robot.home, pillars=np.array([[0.0, 0.25, 0.05]]))
    lain = Frame(bare.place, upright, robot.home, spheres=np.array([[0.0, 0.25, 0.1]]))
    pictures = [
        next(iter(render(robot, [frame], 160, 120, shadows=False))).astype(int) for frame in (bare, stood, lain)
    ]
    assert (np.abs(pictures[1] - pictures[0]).sum(-1) > 30).mean() > 0.01
    red = [(picture[..., 0] - picture[..., 1] > 60).mean() for picture in pictures]
    assert red[2] > 0.005 + 2 * red[0]

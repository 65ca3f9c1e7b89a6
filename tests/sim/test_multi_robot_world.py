"""Several robots in one world: blocks that share nothing, felt by each other and otherwise alone."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from test_scene import TICK, state

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array, Command, Mode
from servoid.hw.contracts.world import Scene
from servoid.hw.robot.description import Robot, load_robot
from servoid.sim.backend import SimBackend
from servoid.sim.model import build
from servoid.sim.multi_robot import Crowd, prefix
from servoid.sim.scene import robot_bodies

NONE = np.zeros((0, 3)), np.zeros((0, 4))


@pytest.fixture(scope="module")
def robot() -> Robot:
    return load_robot()


def scene(*starts: tuple[float, float, float]) -> Scene:
    """Others at their starts, whose goals are 1 m farther along x."""
    robots = np.array([[x, y, heading, x + 1.0, y] for x, y, heading in starts])
    return Scene(*NONE, np.array([2.0, 0.0]), robots)


def hold(body: SimBackend, robot: Robot, ticks: int) -> list[Array]:
    """All hold the home pose; what the first one's sensors said meanwhile."""
    bodies = [body.connect(), *(other.connect() for other in body.simulation.teammates)]
    for _, motors in bodies:
        motors.write(Command(robot.home, np.ones(len(robot.joints)), Mode.ACTIVE))
    seen, start = [], body.clock.now_ns() // TICK
    for tick in range(start + 1, start + ticks + 1):
        body.clock.sleep_until(tick * TICK)
        seen.append(bodies[0][0].read().position)
    return seen


@pytest.mark.parametrize("robots", [2, 3, 4])
def test_each_robot_has_a_block_of_its_own(robot: Robot, robots: int) -> None:
    one = build(robot)
    model = build(robot, scene(*((float(i), 1.0, 0.0) for i in range(1, robots))))
    assert (model.nq, model.nv, model.nu) == (robots * one.nq, robots * one.nv, robots * one.nu)
    assert robot_bodies(model) == one.nbody
    for number in range(robots):
        own = prefix(number)
        joints = [int(model.joint(own + name).qposadr[0]) for name in robot.names]
        assert joints == [number * one.nq + int(one.joint(name).qposadr[0]) for name in robot.names]
        servos = [int(model.actuator(own + name).id) for name in robot.names]
        assert servos == [number * one.nu + int(one.actuator(name).id) for name in robot.names]
        size = model.nsensordata // robots
        assert int(model.sensor(own + "servoid/gyro").adr[0]) == number * size
        assert int(model.sensor(own + "servoid/right_up").adr[0]) == number * size + int(
            one.sensor("servoid/right_up").adr[0]
        )


def test_rows_are_views_of_the_one_world(robot: Robot) -> None:
    crowd = Crowd(build(robot, scene((1.0, 0.0, 0.0))), 2)
    one = build(robot)
    crowd.bind("qpos")[1] = 7.0
    assert not (crowd.bind("qpos")[0] == 7.0).any()
    assert (crowd.bind("qpos")[1] == 7.0).all()
    masses = crowd.expand("body_mass")
    np.testing.assert_array_equal(masses[:, 1:], np.broadcast_to(one.body_mass[1:], (2, one.nbody - 1)))
    masses[0, 1:] = 3.0
    np.testing.assert_array_equal(masses[1, 1:], one.body_mass[1:])
    with pytest.raises(ValueError, match="reset all of them"):
        crowd.reset(np.array([0]))
    with pytest.raises(ValueError, match="not a world of 2 robots"):
        Crowd(one, 2)
    with pytest.raises(ConfigError, match="not yet both"):
        build(robot, replace(scene((1.0, 0.0, 0.0)), pillars=np.ones((1, 3))))


@pytest.mark.parametrize("randomise", [False, True])
def test_a_robot_beside_others_is_what_it_is_alone(robot: Robot, randomise: bool) -> None:
    """But for the floor, of which there is one, so that its friction is not each robot's own."""
    alone = SimBackend(robot, seed=3, randomise=randomise)
    among = SimBackend(robot, seed=3, randomise=randomise, scene=scene((2.0, 0.0, np.pi), (1.0, 1.0, 0.5)))
    tolerance = 1e-9 if not randomise else 0.02
    for a, b in zip(hold(alone, robot, 30), hold(among, robot, 30), strict=True):
        np.testing.assert_allclose(a, b, atol=tolerance)
    assert among.truth.position.shape == (3, 3)
    np.testing.assert_allclose(among.truth.position[:, :2], [[0, 0], [2, 0], [1, 1]], atol=0.05)
    np.testing.assert_allclose(np.abs(among.truth.yaw), [0.0, np.pi, 0.5], atol=0.05)
    assert not among.truth.touching.any()
    assert not among.truth.fallen.any()


def test_the_others_draw_from_streams_of_their_own(robot: Robot) -> None:
    """Stream 1 of a seed is the task's (`stack/runtime/run.py`): its draws and the second robot's would be the same."""
    body = SimBackend(robot, seed=3, scene=scene((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    biases = [drawn.gyro_bias.tolist() for drawn in body._worlds.bodies if drawn is not None]
    same = []
    for stream in range(3):
        rng = np.random.default_rng([3, stream])
        rng.random()
        same.append(rng.uniform(-robot.imu.gyro_bias, robot.imu.gyro_bias, 3).tolist() in biases)
    assert same == [True, False, False]
    assert len({tuple(bias) for bias in biases}) == 3


def test_one_that_is_switched_off_falls_alone(robot: Robot) -> None:
    body = SimBackend(robot, seed=0, scene=scene((1.0, 0.0, 0.0), (0.0, 1.0, 0.0)))
    hold(body, robot, 10)
    body.simulation.teammates[0].close()
    for tick in range(11, 100):
        body.clock.sleep_until(tick * TICK)
    assert body.truth.fallen.tolist() == [False, True, False]


@pytest.mark.parametrize(("apart", "touching"), [(0.25, True), (0.35, False)])
def test_who_stands_too_near_touches(robot: Robot, apart: float, touching: bool) -> None:
    body = SimBackend(robot, seed=0, scene=scene((0.0, apart, 0.0), (3.0, 0.0, 0.0)))
    assert body.truth.touching.tolist() == [touching, touching, False]


def test_each_sees_the_others_and_its_own_goal_from_where_it_is(robot: Robot) -> None:
    body = SimBackend(robot, scene=scene((1.0, 0.5, np.pi / 2), (2.0, 0.0, np.pi)))
    first = body.stage.look(state(0.0, 0.0, 0.0))
    assert first.robots is not None
    np.testing.assert_allclose(first.robots, [[1.0, 0.5, np.pi / 2], [2.0, 0.0, np.pi]], atol=1e-9)
    np.testing.assert_allclose(first.goal, [2.0, 0.0], atol=1e-9)
    second = body.simulation.teammates[0].simulation.surroundings.look(
        state(0.0, 0.0, 0.0)
    )  # which faces along y of the world
    assert second.robots is not None
    np.testing.assert_allclose(second.robots, [[-0.5, 1.0, -np.pi / 2], [-0.5, -1.0, np.pi / 2]], atol=1e-9)
    np.testing.assert_allclose(second.goal, [0.0, -1.0], atol=1e-9)


def test_time_goes_on_by_the_first_ones_clock_alone(robot: Robot) -> None:
    body = SimBackend(robot, scene=scene((1.0, 0.0, 0.0)))
    other = body.simulation.teammates[0].clock
    with pytest.raises(RuntimeError, match="by the first one's clock"):
        other.sleep_until(TICK)
    body.clock.sleep_until(3 * TICK)
    assert other.now_ns() == 3 * TICK

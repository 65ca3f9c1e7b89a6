"""Things with bodies of their own: they roll, stand, fall, are seen, and change nothing for the robot beside them."""

from __future__ import annotations

import json

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array, Command, Mode
from servoid.hw.contracts.control import State
from servoid.hw.contracts.world import Scene, SceneObject, Start
from servoid.hw.geometry import headed
from servoid.hw.robot.description import load_robot
from servoid.sim.backend import SimBackend
from servoid.sim.model import build
from servoid.sim.rig.servo.plant import Plant
from servoid.sim.scene import from_plain, plain
from servoid.sim.worlds import Worlds

ROBOT = load_robot()
BALL = SceneObject("ball", (0.5, 0.1), (0.07, 0.07, 0.07), 0.04)
BAG = SceneObject("bag", (0.6, -0.4), (0.10, 0.14, 0.30), 0.3, heading=0.5)
SEAT = SceneObject("seat", (-0.5, 0.0), (0.12, 0.20, 0.10))
SCENE = Scene(np.zeros((0, 3)), np.zeros((0, 4)), objects=(BALL, BAG, SEAT))
HOME = Command(ROBOT.home, np.ones(20), Mode.ACTIVE)


def worlds(n: int, scene: Scene | None = SCENE) -> Worlds:
    many = Worlds(ROBOT, n, threads=1, model=build(ROBOT, scene))
    many.reset(np.arange(n), [np.random.default_rng(i) for i in range(n)])
    return many


def up(pose: Array) -> float:
    """How far an object's own z axis points up."""
    x, y = pose[4:6]
    return float(1.0 - 2.0 * (x * x + y * y))


def test_left_alone_they_stay_where_they_are_and_the_robot_is_the_same_as_without_them() -> None:
    with_them, alone = worlds(1), worlds(1, None)
    before = with_them.truth.objects.copy()
    np.testing.assert_allclose(before[0, :, :3], [[0.5, 0.1, 0.035], [0.6, -0.4, 0.15], [-0.5, 0.0, 0.05]])
    for _ in range(50):
        with_them.step(HOME)
        alone.step(HOME)
    np.testing.assert_allclose(with_them.truth.objects, before, atol=1e-3)
    np.testing.assert_allclose(with_them.truth.joints, alone.truth.joints, atol=1e-9)
    assert not with_them.truth.touching.any()
    assert not with_them.truth.fallen.any()


def test_each_world_has_its_own_and_they_are_put_anywhere_at_any_time() -> None:
    """Training draws where the ball lies at each reset, of the worlds that begin anew alone."""
    many = worlds(3)
    poses = np.repeat(many.truth.objects[:, :2], 1, 0).copy()
    poses[:, 0, 0] = [0.6, 0.7, 0.8]
    many.reset(np.array([1]), [np.random.default_rng(9)], Start(objects=poses[1:2]))
    np.testing.assert_allclose(many.truth.objects[:, 0, 0], [0.5, 0.7, 0.5])
    many.put(np.array([0, 2]), poses[[0, 2]])
    many.step(HOME)
    np.testing.assert_allclose(many.truth.objects[:, 0, 0], [0.6, 0.7, 0.8], atol=1e-4)
    many.reset(np.array([2]), [np.random.default_rng(9)])
    np.testing.assert_allclose(many.truth.objects[:, 0, 0], [0.6, 0.7, 0.5], atol=1e-4)


def test_a_ball_that_is_dropped_rolls_off_the_seat_and_a_bag_that_leans_falls() -> None:
    many = worlds(1)
    poses = many.truth.objects[:, :2].copy()
    poses[0, 0, :3] = [-0.42, 0.0, 0.2]  # over the seat's edge
    poses[0, 1, 3:] = [np.cos(0.25), 0.0, np.sin(0.25), 0.0]  # by 0.5 rad: its middle is beyond its foot
    many.put(np.array([0]), poses)
    assert up(many.truth.objects[0, 1]) > 0.8
    for _ in range(100):
        many.step(HOME)
    ball, bag, seat = many.truth.objects[0]
    assert ball[0] > -0.40
    assert abs(ball[2] - 0.035) < 0.005
    assert abs(up(bag)) < 0.3
    np.testing.assert_allclose(seat[:3], [-0.5, 0.0, 0.05])


def test_a_ball_slows_down_as_it_rolls() -> None:
    many = worlds(1)
    many._state_qvel[0, many._objects.qvel[0, 0]] = 1.0
    speeds = []
    for _ in range(150):
        many.step(HOME)
        speeds.append(float(many.truth.object_velocity[0, 0, 0]))
    assert 0.5 < speeds[25] < 0.85, "sliding turns into rolling"
    assert 0.05 < (speeds[50] - speeds[149]) / 2.0 < 0.2


def test_they_are_seen_in_the_odometry_frame_wherever_the_robot_believes_to_be() -> None:
    body = SimBackend(ROBOT, scene=SCENE)
    n, believed = np.zeros(20), np.array([2.0, -1.0, 0.26])
    state = State(
        0, np.array([1.0, 0, 0, 0]), np.array([0, 0, -1.0]), np.array(np.pi / 2), n[:3], n[:3], believed, n, n, n[:2]
    )
    assert body.stage is not None
    seen, true = body.stage.look(state).objects, body.truth.objects[0]
    assert seen is not None
    ahead, left = (true[:, :2] - body.truth.position[0, :2]).T
    np.testing.assert_allclose(seen[:, :2], np.column_stack([2.0 - left, -1.0 + ahead]), atol=1e-6)
    np.testing.assert_allclose(seen[:, 2], true[:, 2])
    np.testing.assert_allclose(seen[:, 3:], headed(true[:, 3:], np.full(3, np.pi / 2)), atol=1e-6)


def test_the_virtual_rigs_body_is_the_same() -> None:
    plant = Plant(ROBOT)
    plant.furnish(from_plain(json.loads(json.dumps(plain(SCENE)))))
    np.testing.assert_allclose(plant.truth.objects, worlds(1).truth.objects)


@pytest.mark.parametrize(
    ("values", "message"),
    [
        ({"size": (0.0, 0.1, 0.1)}, "size: must be positive, not 0"),
        ({"mass": 0.0}, "mass: must be positive, not 0"),
    ],
)
def test_what_no_thing_is_is_refused(values: dict[str, object], message: str) -> None:
    with pytest.raises(ValueError, match=message):
        SceneObject(**({"kind": "ball", "place": (0.0, 0.0), "size": (0.07,) * 3, "mass": 0.04} | values))


def test_several_robots_have_no_objects_yet() -> None:
    others = Scene(*(np.zeros((0, 3)), np.zeros((0, 4))), robots=np.zeros((1, 5)), objects=(BALL,))
    with pytest.raises(
        ConfigError, match="a scene has other robots, or pillars, spheres and objects, but not yet both"
    ):
        build(ROBOT, others)

"""What a tracker of key points sees: places and velocities of its body, and how far from those asked they are."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import pytest

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import ReferenceFrames, State
from servoid.hw.geometry import headed, multiply, up_vector
from servoid.hw.robot.description import load_robot
from servoid.hw.robot.mirror import Mirror
from servoid.policy.checkpoint import CheckpointError, header
from servoid.policy.mlp import Mlp
from servoid.policy.motion.library import Library
from servoid.policy.references.clip import ClipReference
from servoid.policy.references.gait import Gait
from servoid.policy.tracker.network import load_tracker
from servoid.policy.tracker.observation import TrackerObservation
from servoid.policy.tracker.points import PointObservation
from servoid.stack.control.tracker import Tracker

ROBOT = load_robot()
SIZE = PointObservation(ROBOT).size
KINDS = 7  # own places, own velocities, four places ahead, velocity
POINTS = 16


def parts(seen: Array) -> Array:
    """What is seen of key points `(..., kinds, points, 3)`."""
    return seen[..., -KINDS * POINTS * 3 :].reshape(*seen.shape[:-1], KINDS, POINTS, 3)


def state(orientation: Array, joints: Array, **changes: Array) -> State:
    values = {
        "orientation": orientation, "gravity": -up_vector(orientation), "yaw": np.zeros(()), "position": joints,
        "angular_velocity": np.zeros(3), "velocity": np.zeros(3), "displacement": np.array([0.0, 0.0, 0.25]),
        "joint_velocity": np.zeros(20), "contact": np.ones(2),
    }  # fmt: skip
    return State(time_ns=0, **(values | changes))


def kicking() -> ReferenceFrames:
    """Frames of a clip, in the middle of a kick."""
    reference = ClipReference(ROBOT, [Library(ROBOT)["kick-high-left"]])
    for _ in range(60):
        reference.advance()
    return reference.frames(PointObservation(ROBOT).ahead)


def test_a_robot_that_is_as_its_reference_differs_by_nothing() -> None:
    frames = kicking()
    turned = headed(frames.root_orientation[0], np.array(0.7))  # wherever it heads
    place = np.array([3.0, -1.0, frames.height[0]])
    here = state(turned, frames.position[0], displacement=place, yaw=np.array(0.7))
    seen = parts(PointObservation(ROBOT)(here, ROBOT.home, frames))
    np.testing.assert_allclose(seen[2], 0.0, atol=1e-5)
    assert np.abs(seen[3:6]).max() > 0.05, "the clip goes on"
    lower = state(turned, frames.position[0], displacement=place - [0, 0, 0.02])
    difference = parts(PointObservation(ROBOT)(lower, ROBOT.home, frames))[2]
    assert np.ptp(difference[:, 2]) < 1e-5
    assert difference[0, 2] > 0.1, "all of it shall be higher"


def test_velocities_are_those_of_the_places() -> None:
    """Of a body that moves, turns and bends, against its places a moment later."""
    rng = np.random.default_rng(0)
    orientation = np.array([0.98, 0.1, -0.15, 0.0])
    orientation = headed(orientation / np.linalg.norm(orientation), np.zeros(()))
    joints, speed, spin = ROBOT.home + rng.normal(0, 0.2, 20), rng.normal(0, 1, 20), np.array([0.5, -0.8, 0.0])
    frames, dt = kicking(), 1e-3
    step = np.concatenate([[1.0], 0.5 * dt * spin])
    later = multiply(orientation, step / np.linalg.norm(step))
    velocity = np.array([0.1, -0.2, 0.3])
    now = state(orientation, joints, velocity=velocity, angular_velocity=spin, joint_velocity=speed)
    then = state(later, joints + dt * speed, displacement=now.displacement + dt * velocity)
    a, b = (parts(PointObservation(ROBOT)(each, ROBOT.home, frames)) for each in (now, then))
    moved = (b[0] - a[0])[:, 2] / (2.5 / ROBOT.walking.height) / dt
    np.testing.assert_allclose(a[1][:, 2] / (0.3 / ROBOT.walking.forward), moved, atol=0.03)
    np.testing.assert_allclose(a[6] + a[1], b[6] + b[1], atol=1e-6)  # what is asked, whatever the robot does


def test_a_mirrored_robot_is_observed_as_the_mirror_image() -> None:
    rng = np.random.default_rng(0)
    joints = Mirror.joints(ROBOT)
    here, there = PointObservation(ROBOT), PointObservation(ROBOT)
    left, right = Gait(ROBOT), Gait(ROBOT)
    left.command(np.array([0.2, 0.1, 0.5]))
    right.command(np.array([0.2, -0.1, -0.5]))
    for _ in range(20):
        position, speed = ROBOT.home + rng.normal(0, 0.1, 20), rng.normal(0, 1, 20)
        lean, rate, velocity = rng.normal(0, 0.05, 2), rng.normal(0, 1, 3), rng.normal(0, 0.2, 3)
        upright, other = (np.array([1.0, s * lean[0], lean[1], 0.0]) for s in (1.0, -1.0))
        seen = here(
            state(upright / np.linalg.norm(upright), position, joint_velocity=speed, angular_velocity=rate,
                  velocity=velocity),
            ROBOT.home, left.frames(here.ahead),
        )  # fmt: skip
        image = there(
            state(other / np.linalg.norm(other), joints(position), joint_velocity=joints(speed),
                  angular_velocity=Mirror.ROTATION(rate), velocity=Mirror.VECTOR(velocity)),
            joints(ROBOT.home), right.frames(there.ahead),
        )  # fmt: skip
        np.testing.assert_allclose(here.mirror(seen), image, atol=1e-4)
        left.advance()
        right.advance()


def untrained(path: Path) -> Path:
    layer = (np.zeros((SIZE, 20), np.float32), np.zeros(20, np.float32))
    head = header("tracker", ROBOT, config={"clips": ["wave"], "points": True}, data="", licence="", results={})
    Mlp([layer], np.zeros(SIZE), np.ones(SIZE)).save(path, head)
    return path


def test_no_joint_of_the_reference_reaches_the_servos(tmp_path: Path) -> None:
    """What a network of key points adds nothing to is the pose in which the robot stands."""
    path = untrained(tmp_path / "points.safetensors")
    _, observation = load_tracker(path, ROBOT)
    assert isinstance(observation, PointObservation)
    assert observation.clips, "it follows any reference"
    reference = ClipReference(ROBOT, [Library(ROBOT)["squat"]])
    for _ in range(40):
        reference.advance()
    tracker = Tracker(ROBOT, str(path), clips=True)
    target = tracker(state(np.array([1.0, 0, 0, 0]), ROBOT.home), ROBOT.home, reference)
    np.testing.assert_array_equal(target, ROBOT.home)


def test_a_network_of_joints_is_not_taken_for_one_of_key_points(tmp_path: Path) -> None:
    inputs = TrackerObservation(ROBOT, clips=True).size
    layer = (np.zeros((inputs, 20), np.float32), np.zeros(20, np.float32))
    head = header("tracker", ROBOT, config={"clips": ["wave"], "points": True}, data="", licence="", results={})
    Mlp([layer], np.zeros(inputs), np.ones(inputs)).save(path := tmp_path / "odd.safetensors", head)
    with pytest.raises(CheckpointError, match=f"takes {inputs} inputs"):
        load_tracker(path, ROBOT)

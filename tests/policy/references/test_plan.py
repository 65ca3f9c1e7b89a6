"""A plan as the tracker sees it: poses at the robot's rate, wherever they are, that go over into the next plan's."""

from __future__ import annotations

import numpy as np
import pytest

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import headed, yaw_of
from servoid.hw.robot.description import load_robot
from servoid.policy.references.clip import BLEND_SHARE
from servoid.policy.references.plan import PlanReference, row_layout

ROBOT = load_robot("op3")
LAYOUT = row_layout(ROBOT)
AHEAD = np.array([0, 3, 8])


def _walk(ticks: int = 40, speed: float = 0.2, turn: float = 0.5, first: float = 1.0, bend: float = 0.0) -> Array:
    """Rows of a walk along an arc that begins somewhere, heading `first` rad."""
    rows = np.zeros((ticks, LAYOUT.size))
    time = np.arange(ticks) * ROBOT.dt
    yaw = first + turn * time
    step = speed * ROBOT.dt * np.stack([np.cos(yaw), np.sin(yaw)], -1)
    rows[:, :2] = np.array([3.0, -2.0]) + np.cumsum(step, 0) - step
    rows[:, 2] = 0.25
    rows[:, LAYOUT.slice("orientation")] = headed(np.tile([1.0, 0.0, 0.0, 0.0], (ticks, 1)), yaw)
    rows[:, LAYOUT.slice("position")] = ROBOT.home + bend
    rows[:, LAYOUT.slice("contact")] = 1.0
    return rows


def test_the_root_is_seen_from_where_the_plan_is_now() -> None:
    reference = PlanReference(ROBOT)
    reference.follow(_walk())
    for _ in range(10):
        frames = reference.frames(AHEAD)
        np.testing.assert_allclose(frames.root_position[0], [0.0, 0.0, 0.25], atol=1e-9)
        np.testing.assert_allclose(yaw_of(frames.root_orientation), 0.5 * AHEAD * ROBOT.dt, atol=1e-9)
        np.testing.assert_allclose(frames.root_position[:, 0], 0.2 * AHEAD * ROBOT.dt, atol=1e-3)
        np.testing.assert_allclose(frames.yaw_rate, 0.5, atol=1e-6)
        np.testing.assert_allclose(frames.velocity, np.tile([0.2, 0.0], (3, 1)), atol=3e-3)
        reference.advance()


def test_a_plan_that_has_ended_holds_its_last_pose_at_rest() -> None:
    reference = PlanReference(ROBOT)
    reference.follow(_walk(20, bend=0.1))
    assert not reference.ended
    for _ in range(30):
        reference.advance()
    assert reference.ended
    frames = reference.frames(AHEAD)
    assert not frames.velocity.any()
    assert not frames.yaw_rate.any()
    np.testing.assert_allclose(frames.position, np.clip(ROBOT.home + 0.1, ROBOT.lower, ROBOT.upper)[None].repeat(3, 0))


def test_another_plan_is_gone_over_to_without_a_jump() -> None:
    """The joints of a plan begin where the robot is, and the goals before them are where it was to be."""
    reference = PlanReference(ROBOT)
    reference.follow(_walk())
    seen = []
    for tick in range(60):
        if tick == 20:
            reference.follow(_walk(bend=0.3))
        seen.append(reference.frames(AHEAD).position[0])
        reference.advance()
    steps = np.abs(np.diff(seen, axis=0)).max()
    assert 0.0 < steps <= BLEND_SHARE * ROBOT.limits.joint_speed * ROBOT.dt * 1.01
    np.testing.assert_allclose(seen[-1], np.clip(ROBOT.home + 0.3, ROBOT.lower, ROBOT.upper))


def test_one_world_of_many_stands_while_the_others_go_on() -> None:
    reference = PlanReference(ROBOT, (2,))
    reference.follow(np.stack([_walk(), _walk(speed=0.1)]))
    for _ in range(10):
        reference.advance()
    before = reference.frames(AHEAD)
    reference.stand(np.tile(ROBOT.home, (2, 1)), np.array([True, False]))
    after = reference.frames(AHEAD)
    assert not after.velocity[0].any()
    np.testing.assert_allclose(after.velocity[1], before.velocity[1], atol=5e-3)
    np.testing.assert_allclose(after.root_position[1], before.root_position[1], atol=1e-9)
    with pytest.raises(ValueError, match="broadcast"):
        reference.follow(np.zeros((3, 5, LAYOUT.size)))

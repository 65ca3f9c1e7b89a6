"""A clip as the tracker sees it: where it is, how fast it goes, and that it is entered and left without a jump."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_clips import ABOUT, walking_in_a_circle

from servoid.hw.config import ConfigError
from servoid.hw.geometry import turned, yaw_of
from servoid.hw.robot.description import load_robot
from servoid.policy.references.clip import BLEND_SHARE, ClipReference

ROBOT = load_robot()
CLIP = walking_in_a_circle(ROBOT)
LOOP = walking_in_a_circle(ROBOT, about=replace(ABOUT, loop=True))
AHEAD = np.array([0, 1, 5, 20])


def played(reference: ClipReference, ticks: int) -> ClipReference:
    for _ in range(ticks):
        reference.advance()
    return reference


@pytest.mark.parametrize("rate", [0.5, 1.0, 2.0])
def test_frames_are_those_of_the_clip_at_its_rate(rate: float) -> None:
    reference = ClipReference(ROBOT, [CLIP])
    reference.play(0, rate=rate)
    frames = played(reference, 4).frames(AHEAD)
    at = np.minimum(rate * (4 + AHEAD), CLIP.ticks - 1)
    np.testing.assert_allclose(frames.position, CLIP.sampled(at).joints, atol=1e-9)
    np.testing.assert_allclose(frames.height, 0.25)
    seconds = (CLIP.ticks - 1) * ROBOT.dt
    np.testing.assert_allclose(frames.velocity[0], [rate * 0.5 / seconds, 0.0], atol=2e-3)
    assert frames.yaw_rate[0] == pytest.approx(rate * 0.5 / seconds, rel=1e-3)


def test_the_root_is_seen_from_where_the_reference_is() -> None:
    """So that a clip is tracked wherever the robot stands: along an arc, every tick looks the same."""
    reference = ClipReference(ROBOT, [CLIP])
    one, other = reference.frames(AHEAD[:3]), played(reference, 17).frames(AHEAD[:3])
    np.testing.assert_allclose(one.root_position, other.root_position, atol=1e-4)
    np.testing.assert_allclose(one.root_position[0], [0.0, 0.0, 0.25], atol=1e-12)
    assert yaw_of(one.root_orientation[0]) == pytest.approx(0.0, abs=1e-12)
    assert one.root_position[2, 0] == pytest.approx(0.05, abs=1e-3)
    assert yaw_of(one.root_orientation[2]) == pytest.approx(0.05, abs=1e-3)


def test_joint_velocity_is_the_change_of_position() -> None:
    reference = ClipReference(ROBOT, [LOOP])
    reference.play(0, rate=1.3)
    reference.enter(ROBOT.home + 0.2)
    for _ in range(60):
        before, now, after = (reference.frames(np.array([k])) for k in (-1, 0, 1))
        change = (after.position - before.position) / (2 * ROBOT.dt)
        np.testing.assert_allclose(now.joint_velocity, change, atol=0.15)
        reference.advance()


def test_a_clip_ends_in_its_last_frame_at_rest() -> None:
    reference = played(ClipReference(ROBOT, [CLIP]), 49)
    assert not reference.ended
    assert played(reference, 1).ended
    frames = played(reference, 30).frames(AHEAD)
    np.testing.assert_allclose(frames.position, np.broadcast_to(CLIP.joints[-1], frames.position.shape), atol=1e-12)
    assert not frames.velocity.any()
    assert not frames.joint_velocity.any()
    assert not frames.yaw_rate.any()
    assert reference.phase == 1.0


@pytest.mark.parametrize("turn", [0.0, 0.5, -2.0])
def test_a_loop_carries_its_place_and_heading_along(turn: float) -> None:
    """Three rounds of an arc are one arc three times as long."""
    loop = walking_in_a_circle(ROBOT, about=replace(ABOUT, loop=True), turn=turn)
    reference = ClipReference(ROBOT, [loop])
    ahead = np.array([0, 50, 75, 100, 150])
    frames = reference.frames(ahead)
    share = ahead / 50
    radius = 0.5 / turn if turn else 0.0
    x = radius * np.sin(turn * share) if turn else 0.5 * share
    y = radius * (1 - np.cos(turn * share)) if turn else 0.0 * share
    np.testing.assert_allclose(frames.root_position[:, 0], x, atol=1e-3)
    np.testing.assert_allclose(frames.root_position[:, 1], y, atol=1e-3)
    expected = turned(np.array([1.0, 0.0]), turn * share)
    heading = yaw_of(frames.root_orientation)
    np.testing.assert_allclose(np.stack([np.cos(heading), np.sin(heading)], -1), expected, atol=1e-3)
    assert not played(reference, 500).ended


@pytest.mark.parametrize("away", [0.05, 1.0, -1.2])
def test_it_begins_in_the_pose_that_the_robot_is_in_and_no_faster_than_the_guard_allows(away: float) -> None:
    reference = ClipReference(ROBOT, [CLIP])
    pose = np.clip(ROBOT.home + away, ROBOT.lower, ROBOT.upper)
    reference.enter(pose)
    positions = []
    for _ in range(200):
        positions.append(reference.frames(np.array([0])).position[0])
        reference.advance()
    np.testing.assert_allclose(positions[0], pose, atol=1e-9)
    np.testing.assert_allclose(positions[-1], CLIP.joints[-1], atol=1e-9)
    own = np.abs(np.diff(CLIP.joints, axis=0)).max()
    fastest = np.abs(np.diff(positions, axis=0)).max()
    assert fastest <= BLEND_SHARE * ROBOT.limits.joint_speed * ROBOT.dt + own + 1e-9


def test_many_worlds_play_their_own_clips_as_one_does() -> None:
    many = ClipReference(ROBOT, [CLIP, LOOP], (3,))
    many.play(np.array([0, 1, 0]), time=np.array([0.0, 10.0, 3.5]), rate=np.array([1.0, 0.5, 2.0]))
    many.enter(np.tile(ROBOT.home + 0.1, (3, 1)), np.array([True, False, False]))
    played(many, 7)
    frames = many.frames(AHEAD)
    for world, (clip, time, rate) in enumerate([(CLIP, 0.0, 1.0), (LOOP, 10.0, 0.5), (CLIP, 3.5, 2.0)]):
        one = ClipReference(ROBOT, [clip])
        one.play(0, time=time, rate=rate)
        if world == 0:
            one.enter(ROBOT.home + 0.1)
        alone = played(one, 7).frames(AHEAD)
        for name in type(frames).__dataclass_fields__:
            np.testing.assert_allclose(getattr(frames, name)[world], getattr(alone, name), atol=1e-9, err_msg=name)
    many.reset(np.array([True, False, False]))
    assert many.time.tolist() == [0.0, 13.5, 17.5]


def test_a_clip_beyond_the_joint_ranges_is_refused() -> None:
    joints = CLIP.joints.copy()
    joints[3, 11] = ROBOT.upper[11] + 0.2
    with pytest.raises(ConfigError, match=r"clip 'circle': l_knee goes 0\.20 rad beyond the robot's range"):
        ClipReference(ROBOT, [replace(CLIP, joints=joints)])
    with pytest.raises(ConfigError, match="at least one clip"):
        ClipReference(ROBOT, [])


def test_a_clip_that_does_not_begin_upright_waits_for_the_robot_in_its_first_frame() -> None:
    lying = replace(CLIP, about=replace(CLIP.about, begins="lying on the back"))
    waits, runs = ClipReference(ROBOT, [lying]), ClipReference(ROBOT, [CLIP])
    pose = CLIP.joints[0] + 0.5
    for reference in (waits, runs):
        reference.play(0)
        reference.enter(pose)
    ahead = waits.frames(np.arange(100))
    ticks = int(np.flatnonzero(ahead.root_position[:, 0] > 1e-9)[0]) - 1  # the last one of waiting
    assert 10 < ticks < 40
    np.testing.assert_allclose(ahead.position[ticks], CLIP.joints[0], atol=1e-3)
    assert (ahead.velocity[:ticks] == 0.0).all()
    for tick in range(60):
        now = waits.frames(np.zeros(1, int))
        np.testing.assert_allclose(now.position[0], ahead.position[tick], atol=1e-9)
        assert (waits.time == 0.0) == (tick <= ticks)
        waits.advance()
        runs.advance()
    assert runs.time == 60.0, "one that begins upright plays meanwhile"

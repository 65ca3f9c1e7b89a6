"""Gait and clip as one reference: who follows which, and no jump from one to the other."""

from __future__ import annotations

import numpy as np
import pytest
from made_clips import walking_in_a_circle

from servoid.hw.robot.description import load_robot
from servoid.policy.references.clip import BLEND_SHARE
from servoid.policy.references.either import GaitOrClip

ROBOT = load_robot()
CLIP = walking_in_a_circle(ROBOT)
NOW = np.zeros(1, int)


@pytest.mark.parametrize("shape", [(), (2,)])
def test_a_world_goes_over_to_a_clip_and_back_without_a_jump(shape: tuple[int, ...]) -> None:
    reference = GaitOrClip(ROBOT, [CLIP], shape)
    first = np.arange(np.prod(shape, dtype=int)).reshape(shape) == 0  # the world that plays
    pose = np.broadcast_to(ROBOT.home + 0.3, (*shape, 20))
    seen = []
    for tick in range(3 * CLIP.ticks):
        if tick == 5:
            reference.play(0, pose, first)
        if (over := reference.ended).any():
            reference.stand(seen[-1], over)
        assert (reference.on_clip == (first & (5 <= tick < 5 + CLIP.ticks - 1))).all()
        seen.append(reference.frames(NOW).position[..., 0, :])
        reference.advance()
    path = np.array(seen)[5:]  # where it began the robot was elsewhere than the reference
    steps = np.abs(np.diff(path, axis=0)).max((0, -1))
    allowed = BLEND_SHARE * ROBOT.limits.joint_speed * ROBOT.dt
    assert (steps < allowed + 0.1 * 2 * np.pi / (CLIP.ticks - 1) + 1e-9).all()
    np.testing.assert_allclose(path[0][first], pose[first])
    np.testing.assert_allclose(path[-1], np.broadcast_to(ROBOT.home, path[-1].shape), atol=0.35)  # the gait's stance
    if shape:
        np.testing.assert_array_equal(path[:, 1], np.broadcast_to(path[0, 1], path[:, 1].shape)), "it stands on"


def test_each_world_gets_the_frames_of_what_it_follows() -> None:
    reference = GaitOrClip(ROBOT, [CLIP], (2,))
    reference.play(0, np.tile(CLIP.joints[0], (2, 1)), np.array([False, True]))
    frames = reference.frames(np.array([0, 4]))
    gait, clip = reference.gait.frames(np.array([0, 4])), reference.clip.frames(np.array([0, 4]))
    for name in ("position", "velocity", "root_position", "root_orientation", "height", "contact"):
        np.testing.assert_array_equal(getattr(frames, name)[0], getattr(gait, name)[0], err_msg=name)
        np.testing.assert_array_equal(getattr(frames, name)[1], getattr(clip, name)[1], err_msg=name)

"""What worlds of the tracker's training follow, how episodes begin and end, and which clips come more often."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest
from made_clips import walking_in_a_circle

from servoid.hw.geometry import up_vector
from servoid.hw.robot.description import load_robot
from servoid.policy.motion.clip import Clip
from servoid.policy.motion.library import Library
from servoid.tools.learn.envs.starts import along, lying
from servoid.tools.learn.envs.tracking import Tracking
from servoid.tools.learn.settings import TrackingSettings

ROBOT = load_robot()
STILL = replace(walking_in_a_circle(ROBOT, ticks=26, turn=0.0), name="still")
STILL = replace(STILL, joints=np.tile(ROBOT.home, (26, 1)), root_position=np.tile([0.0, 0.0, 0.259], (26, 1)))


def impossible() -> Clip:
    """It is said to hang in the air."""
    return replace(STILL, name="hang", root_position=STILL.root_position + np.array([0.0, 0.0, 0.3]))


def test_bodies_that_were_dropped_lie_still_on_both_sides() -> None:
    states = lying(ROBOT, 64, seed=1)
    assert len(states.clip) > 40
    assert 0.2 < states.front.mean() < 0.8
    assert (up_vector(states.orientation)[:, 2] < 0.5).all()
    assert (np.abs(states.angular_velocity) < 0.3).all()
    assert (states.position[:, 2] < 0.2).all()


def test_states_along_a_clip_are_of_rollouts_that_do_as_it_does() -> None:
    states = along(ROBOT, [STILL, impossible()], 4, seed=0)
    assert (states.clip == 0).all(), "what fails is not begun in"
    assert set(states.time) == {0, 5, 10, 15, 20}
    assert np.abs(states.joints - ROBOT.home).max() < 0.2
    assert (up_vector(states.orientation)[:, 2] > 0.99).all()


@pytest.mark.slow
def test_clips_are_followed_between_walks_and_what_fails_comes_more_often() -> None:
    settings = TrackingSettings(clip_share=1.0, walk_seconds=(0.2, 0.4), episode_seconds=6.0, hardest_push=0.0)
    env = Tracking(ROBOT, 8, None, settings, clips=[STILL, impossible()])
    env.reset()
    clips, walked, ended = np.zeros(2, int), 0, 0
    for _ in range(400):
        before = env.motions.on_clip.copy()
        _, done, late = env.step(np.zeros((8, 20)))
        on_clip = env.motions.on_clip
        entered = on_clip & ~before & ~done
        walked += int((before & ~on_clip & ~done).sum())
        ended += int((done & ~late).sum())
        for clip in env.reference.clip.clip[entered]:
            clips[clip] += 1
        assert np.isfinite(env.observations["critic"]).all()
    assert env.measures["success/still"] > 0.6
    assert env.measures["success/hang"] < 0.4
    assert clips[1] > clips[0] > 0
    assert walked > 0, "after a clip that went well the robot walks on"
    assert ended > 0, "what is far from its clip for half a second has failed"


@pytest.mark.slow
def test_a_robot_that_lies_begins_a_clip_that_gets_it_up() -> None:
    library = Library(ROBOT)
    clips = [library["get-up-front"], library["get-up-back"]]
    env = Tracking(ROBOT, 16, None, TrackingSettings(clip_share=1.0, hardest_push=0.0), clips=clips)
    env.reset()
    assert env.motions.on_clip.all()
    along_it = env.reference.clip.time > 0
    lies = env.fleet.truth.tilt > 1.0
    assert lies[~along_it].all()
    front = env.fleet.truth.gravity[:, 0] > 0.0
    np.testing.assert_array_equal((env.reference.clip.clip == 0)[~along_it], front[~along_it])
    assert not env.step(np.zeros((16, 20)))[1].any(), "it has the time to come from its pose to the clip's"


def test_a_robot_without_clips_follows_the_gait_alone() -> None:
    env = Tracking(ROBOT, 2, None, TrackingSettings())
    env.reset()
    for _ in range(60):
        env.step(np.zeros((2, 20)))
        assert not env.motions.on_clip.any()


@pytest.mark.parametrize("changes", [{"clip_share": 1.5}, {"rates": (0.0, 1.0)}, {"walk_seconds": (3.0, 2.0)}])
def test_settings_that_make_no_sense_are_refused(changes: dict[str, object]) -> None:
    with pytest.raises(ValueError, match=next(iter(changes))):
        TrackingSettings(**changes)  # type: ignore[arg-type]

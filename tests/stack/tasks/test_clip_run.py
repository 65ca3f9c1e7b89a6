"""Imitating a clip: what is learned, and how a run of it is judged."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.contracts.task import Trace
from servoid.hw.robot.description import load_robot
from servoid.policy.motion.library import find
from servoid.stack.tasks.learned import load_learned_task
from servoid.stack.tasks.learned.clip_run import ClipSettings, RunClip
from servoid.tools.learn.envs.starts import AlongClip

ROBOT, DT = load_robot(), 0.02


def trace_of(name: str, wait: int = 40) -> Trace:
    """Of a robot that waits, and then does just what the clip shows."""
    clip = find(name, ROBOT)
    rows = np.r_[np.zeros(wait, int), np.arange(clip.ticks)]
    n, still = len(rows), np.zeros((len(rows), 3))
    return Trace(
        DT, clip.root_position[rows], np.zeros(n), still, np.zeros(n), still, fallen=False,
        joints=clip.joints[rows], orientation=clip.root_orientation[rows],
    )  # fmt: skip


def test_who_does_as_the_clip_shows_has_no_error_whenever_it_begins_and_who_stands_has() -> None:
    task = RunClip(ClipSettings(clip="squat"), DT, ROBOT)
    episode = task.scenario(np.random.default_rng(0))
    does = trace_of("squat")
    assert task.metrics(does, episode)["clip_error_m"] == pytest.approx(0.0, abs=1e-9)
    assert task.success(does, episode)
    assert does.joints is not None
    stands = replace(does, joints=np.tile(does.joints[:1], (len(does.yaw), 1)))
    assert task.metrics(stands, episode)["clip_error_m"] > 0.02
    assert not task.success(stands, episode)
    assert not task.success(replace(does, fallen=True), episode)


def test_a_clip_that_cannot_be_run_is_refused() -> None:
    with pytest.raises(ConfigError, match="no clip is named: give --set clip=NAME"):
        RunClip(ClipSettings(), DT, ROBOT).scenario(np.random.default_rng(0))
    with pytest.raises(ConfigError, match="begins lying on the front, and a run begins standing"):
        RunClip(ClipSettings(clip="get-up-front"), DT, ROBOT)
    with pytest.raises(ConfigError, match="unknown clip 'squad'"):
        load_learned_task("clip:squad", ROBOT)


def test_what_goes_to_the_ground_ends_by_no_fall_and_a_pose_of_the_clip_is_rewarded() -> None:
    kick, sit = (load_learned_task(f"clip:{name}", ROBOT) for name in ("kick-left", "sit-down"))
    assert (kick.grounded, sit.grounded) == (False, True)
    assert kick.motion is not None
    assert (kick.name, kick.motion.name) == ("clip:kick-left", "kick-left")


def test_episodes_begin_in_the_first_pose_of_the_clip_or_along_it() -> None:
    clip, where = find("sit-down", ROBOT), np.ones(6, bool)
    rngs = [np.random.default_rng(i) for i in range(6)]
    first = AlongClip(ROBOT, clip, 0.0, 0).draw(rngs, where)
    assert first.joints == pytest.approx(np.tile(clip.joints[0], (6, 1)))
    loop = replace(clip, about=replace(clip.about, loop=True))
    assert AlongClip(ROBOT, loop, 0.0, 0).draw(rngs, where).joints == pytest.approx(np.tile(ROBOT.home, (6, 1)))
    along = AlongClip(ROBOT, clip, 1.0, 0).draw(rngs, where)
    assert along.joints is not None
    assert np.ptp(along.joints, axis=0).max() > 0.5  # some stand, some sit

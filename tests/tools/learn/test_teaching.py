"""Who teaches: clips that are played round and round, and gaits, neither by a clock of their own."""

from __future__ import annotations

from dataclasses import replace

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction
from servoid.hw.contracts.world import Start
from servoid.hw.robot.description import load_robot
from servoid.policy.motion.library import find
from servoid.stack.control.fleet import Fleet
from servoid.stack.control.tracker import ExpertPolicy
from servoid.stack.tasks.learned import load_learned_task
from servoid.tools.learn.teaching import GaitInStep, RoundOfClips, teaching

ROBOT = load_robot()
TOLD = Instruction(np.zeros((1, 3)))
_STATE = Fleet(ROBOT, 1, None).observe()


def after(round_: RoundOfClips, applied: Array, ticks: int) -> list[int]:
    """Frames that it came to in `ticks`, where its targets are followed from `applied` on."""
    frames = []
    for _ in range(ticks):
        applied = round_.act(_STATE, applied, TOLD)
        frames.append(int(round_.frame[0]))
    return frames


def test_one_clip_follows_the_other_and_the_first_the_last() -> None:
    clips = [find(name, ROBOT) for name in ("sit-down", "rise")]
    total = sum(clip.ticks for clip in clips)
    made = RoundOfClips(ROBOT, clips, (1,))
    made.reset(None, np.zeros(1, np.uint32))
    frames = np.array(after(made, ROBOT.home[None], 2 * total))
    forward = np.diff(frames) % total
    assert (forward >= 1).all()  # it rests nowhere
    assert np.median(forward) == 1  # and plays them as fast as they are
    assert np.sum(np.diff(frames) < 0) >= 2


def test_it_goes_on_from_where_its_pupil_went() -> None:
    clip = find("sit-down", ROBOT)
    made = RoundOfClips(ROBOT, [clip], (1,))
    made.reset(None, np.zeros(1, np.uint32))
    after(made, ROBOT.home[None], 5)
    for frame in (30, 45, 40):  # ahead, and back
        target = made.act(_STATE, clip.joints[frame][None], TOLD)
        assert np.allclose(target, clip.joints[frame + 1], atol=0.01)


def test_a_new_episode_begins_at_the_pose_it_finds() -> None:
    clip = find("sit-down", ROBOT)
    made = RoundOfClips(ROBOT, [clip], (1,))
    made.reset(None, np.zeros(1, np.uint32))
    sits = replace(_STATE, position=clip.joints[-20][None])
    made.act(sits, clip.joints[-20][None], TOLD)
    assert made.frame[0] >= clip.ticks - 21


def test_an_unknown_clip_is_refused_by_its_name() -> None:
    task = load_learned_task("clip:sit-down", ROBOT)
    with pytest.raises(ConfigError, match=r"unknown clip 'risen'.*rise"):
        teaching("sit-down+risen", task, None, None, 1)


def test_who_goes_by_a_velocity_teaches_no_task_that_tells_none() -> None:
    with pytest.raises(ConfigError, match=r"--teacher expert walks as it is told a velocity, and task location tells"):
        teaching("expert", load_learned_task("location", ROBOT), None, None, 1)
    assert isinstance(teaching("expert", load_learned_task("steering", ROBOT), None, None, 1), ExpertPolicy)


def test_a_gait_keeps_in_step_with_legs_that_another_moves() -> None:
    """One expert walks, and the gait of another who watches is put elsewhere in its cycle."""
    n, fleet = 6, Fleet(ROBOT, 6, None)
    fleet.reset(np.ones(n, bool), Start())
    walks, watches = (ExpertPolicy(ROBOT, shape=(n,)) for _ in range(2))
    for policy in (walks, watches):
        policy.reset(None, np.zeros(n, np.uint32))
    clock, told = GaitInStep(watches.gait), Instruction(np.tile([0.2, 0.0, 0.0], (n, 1)))
    off = np.array([0.0, 0.1, 0.2, -0.1, -0.2, 0.35])
    for tick in range(150):
        state = fleet.observe()
        clock(state, np.full(n, tick < 60))
        watches.act(state, fleet.applied, told)
        fleet.step(walks.act(state, fleet.applied, told))
        if tick == 60:  # until then it is moved by what it measures
            watches.gait.phase = (watches.gait.phase + off) % 1.0
    late = (watches.gait.phase - walks.gait.phase + 0.5) % 1.0 - 0.5
    assert np.abs(late).max() < 0.06

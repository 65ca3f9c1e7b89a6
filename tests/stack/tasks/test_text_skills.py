"""Sentences about skills: drawn, judged by what the joints did, and refused where the policy knows no skills."""

from __future__ import annotations

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.hw.contracts.task import Trace
from servoid.hw.robot.description import load_robot
from servoid.policy.text.captions import NAMES
from servoid.stack.runtime.run import RunSettings, run
from servoid.stack.tasks import load_task
from servoid.stack.tasks.text import Text

ROBOT = load_robot()


def text(**settings: str) -> Text:
    task = load_task("text", settings, ROBOT.dt, ROBOT)
    assert isinstance(task, Text)
    return task


def test_skills_and_walks_are_drawn_each_with_one_of_its_held_out_phrases_and_rising_only_from_a_seat() -> None:
    task = text(about="both", every="4", seconds="4000")
    episode = task.scenario(np.random.default_rng(0))
    skills = [motion for motion in episode.motions if isinstance(motion, str)]
    assert {*skills, "rise"} == set(task.skills)  # which is drawn but rarely
    assert len({motion for motion in episode.motions if isinstance(motion, int)}) == len(NAMES)
    assert episode.told == tuple(dict.fromkeys(skills))
    assert episode.low
    for before, motion, sentence in zip(("", *episode.motions), episode.motions, episode.sentences, strict=False):
        assert motion != "rise" or before == "sit-down"
        if isinstance(motion, str):
            assert sentence in task.skills[motion].held_out
    walks = text(every="4", seconds="400").scenario(np.random.default_rng(0))
    assert walks.told == ()
    assert all(isinstance(motion, int) for motion in walks.motions)


def test_a_sentence_counts_as_followed_where_the_joints_did_what_it_says() -> None:
    task = text(about="both", every="4", seconds="12")
    every, stand = round(4 / ROBOT.dt), NAMES.index("stand")
    joints = np.tile(ROBOT.home, (3 * every, 1))
    for name, at in (("nod", 20), ("kick-low-right", every + 30)):
        shown = task.shown[name].joints
        joints[at : at + len(shown)] = shown
    none = np.zeros((3 * every, 3))
    trace = Trace(ROBOT.dt, none, np.zeros(3 * every), none, np.zeros(3 * every), none, False, joints=joints)
    assert task.verdicts(trace, ["nod", "kick-low-right", stand]) == [True, True, True]
    assert task.verdicts(trace, ["nod", "kick-low-left", "wave"]) == [True, False, False]


def test_a_policy_that_knows_no_skills_is_refused_with_what_to_do() -> None:
    with pytest.raises(ConfigError, match=r"knows no skills.*wave.*use --policy skills"):
        run(RunSettings("text", policy="gait", set={"sentence": "wave your hand", "seconds": "5"}))

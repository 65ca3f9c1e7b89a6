"""Sentences that ask for skills, or for walking, or for what nobody here can do."""

from __future__ import annotations

import numpy as np
import pytest
from fake_body import StillEstimator, observation

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.robot.description import load_robot
from servoid.policy.text.captions import MOTIONS
from servoid.policy.text.encoder import load_encoder
from servoid.stack.control.base import BasePolicy
from servoid.stack.skills.rewording import RewordedPolicy
from servoid.stack.skills.skill import load_skills
from servoid.stack.skills.words import SkillWords
from servoid.stack.tasks import load_task

SKILLS = load_skills(load_robot())
WORDS = SkillWords(load_encoder(), SKILLS)


def heard(text: str) -> str | int:
    try:
        return WORDS.understand(text)
    except ConfigError:
        return ""


def test_every_phrase_names_its_skill() -> None:
    assert {text: heard(text) for skill in SKILLS.values() for text in skill.phrases} == {
        text: name for name, skill in SKILLS.items() for text in skill.phrases
    }


def test_most_held_out_phrases_are_understood() -> None:
    pairs = [(name, heard(text)) for name, skill in SKILLS.items() for text in skill.held_out]
    assert sum(name == found for name, found in pairs) >= 0.93 * len(pairs)


def test_what_is_said_of_a_known_motion_is_told_in_the_words_of_the_training() -> None:
    """The nearest sentence alone takes "sidestep left" for a reach to the left side, and without a place that it leads
    to a walk begins without a step."""
    heard: list[Instruction] = []

    class Hearing(BasePolicy):
        def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
            heard.append(instruction)
            return applied

    robot = load_robot()
    policy = RewordedPolicy(robot, Hearing(), ["lie down on your back"], 2.0)
    state = StillEstimator(robot).update(observation(robot, 0, robot.home), robot.home)
    said = ("sidestep left", "have a seat on the stool", "lie down on your back", "solve the equation", "???", None)
    for text in said:
        policy.act(state, robot.home, Instruction(np.zeros(3), text=text))
    assert [one.text for one in heard] == ["side-step to the left", "sit on the seat", *said[2:]]
    assert [one.targets is not None for one in heard] == [True] + 5 * [False]
    assert heard[0].targets is not None
    np.testing.assert_allclose(heard[0].targets["ground"], [0.0, 2.0 * 0.16 * robot.walking.scale[1]], atol=1e-9)
    assert heard[0].targets["heading"] == 0.0
    mine = {"ground": np.ones(2)}
    policy.act(state, robot.home, Instruction(np.zeros(3), text="sidestep left", targets=mine))
    assert heard[-1].targets is mine, "what is asked for stays"


def test_a_skill_is_told_in_the_phrase_that_is_least_like_any_others() -> None:
    assert WORDS.clearest("kick-left") == "strike the ball with the left leg"
    assert all(WORDS.clearest(name) in skill.phrases for name, skill in SKILLS.items())


def test_sentences_about_walking_stay_about_walking() -> None:
    assert all(isinstance(WORDS.understand(text), int) for motion in MOTIONS for text in motion.phrasings)


@pytest.mark.parametrize("text", ["wave", "kick forward", "please sit down"])
def test_a_task_that_only_walks_says_where_skills_are_performed(text: str) -> None:
    with pytest.raises(ConfigError, match=f"asks for a skill: use servoid run skill --set text='{text}'"):
        load_task("goal", {"text": text})


@pytest.mark.parametrize(
    ("text", "message"),
    [
        ("kick", "does not say with which side; add 'left' or 'right'"),
        ("kick forward", "does not say with which side"),
        ("wave with the left hand", "says 'left', but 'wave' has no side to choose"),
        ("kick left and right", "asks for both left and right"),
        ("do not kick with the left foot", "says what not to do"),
        ("wave, then sit down", "one thing after another"),
        ("wave three times", "says how much"),
        ("make coffee", "asks for nothing that is known; the nearest skill is"),
        ("play the violin", "asks for nothing that is known"),
        ("setz dich hin", "asks for nothing that is known"),
        ("", "is empty"),
    ],
)
def test_what_cannot_be_told_is_refused(text: str, message: str) -> None:
    with pytest.raises(ConfigError, match=message):
        WORDS.understand(text)

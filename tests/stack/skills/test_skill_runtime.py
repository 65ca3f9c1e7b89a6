"""From any skill to any other, by goals alone: a body that does at once what it is told."""

from __future__ import annotations

from collections.abc import Iterator
from dataclasses import replace

import numpy as np
import pytest
from fake_body import StillEstimator, observation

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.robot.description import load_robot
from servoid.policy.motion.library import Library
from servoid.stack.control.base import BasePolicy
from servoid.stack.safety.limits import limit
from servoid.stack.skills.runtime import SkillPolicy
from servoid.stack.skills.skill import load_skills

ROBOT = load_robot()
# What is tested goes from one skill to another, whatever performs them: their goals alone need no body.
SKILLS = {name: replace(skill, policy="clip") for name, skill in load_skills(ROBOT).items()}
CLIPS = Library(ROBOT)
STEP = ROBOT.limits.joint_speed * ROBOT.dt
SEATED = CLIPS["sit-down"].joints[-1]


class Stands(BasePolicy):
    """Stays at home, or sways; remembers what it was asked."""

    def __init__(self) -> None:
        self.asked: list[Instruction] = []

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        self.asked.append(instruction)
        return ROBOT.home + 0.4 * abs(instruction.velocity[0]) * np.sin(0.5 * len(self.asked))


class Robot:
    """A robot that is told instructions, and what it did."""

    def __init__(self) -> None:
        self.stands = Stands()
        self.policy = SkillPolicy(ROBOT, self.stands, SKILLS)
        self.policy.reset(None, np.zeros((), int))
        self.applied, self.events = ROBOT.home.copy(), list[str]()
        self._estimator = StillEstimator(ROBOT)

    def do(self, seconds: float, skill: str | None, *, velocity: float = 0.0, stand: bool = False) -> Array:
        """Goals `(ticks, n_joints)` as the limits let them through; no wish is held back by them."""
        state = self._estimator.update(observation(ROBOT, 0, self.applied), self.applied)
        instruction = Instruction(np.array([velocity, 0.0, 0.0]), skill=skill, stand=stand)
        goals = []
        for _ in range(round(seconds * ROBOT.rate)):
            target = self.policy.act(state, self.applied, instruction)
            assert np.abs(target - self.applied).max() < 1.05 * STEP
            self.applied = limit(target, self.applied, ROBOT)
            goals.append(self.applied)
            self.events += self.policy.take_events()
        return np.array(goals)


def begun(events: list[str]) -> Iterator[str]:
    return (text.split("'")[1] for text in events if text.endswith("begins"))


def test_a_skill_begins_at_once_is_performed_once_and_then_the_robot_stands() -> None:
    robot = Robot()
    goals = robot.do(12.0, "wave")
    clip = CLIPS["wave"].joints
    np.testing.assert_allclose(goals[50 : len(clip)], clip[50:], atol=STEP)
    np.testing.assert_allclose(goals[-1], ROBOT.home, atol=1e-9)
    assert list(begun(robot.events)) == ["wave"]
    robot.do(0.1, None)
    robot.do(2.0, "wave")
    assert list(begun(robot.events)) == ["wave", "wave"], "asked for anew, it is done anew"


@pytest.mark.parametrize("first", ["wave", "kick-left", "sit-down", "rise"])
@pytest.mark.parametrize("second", ["bow", "kick-right", "sit-down", "rise"])
def test_any_skill_leads_to_any_other_in_mid_motion_within_the_limits(first: str, second: str) -> None:
    """`do` asserts that no wish leaps."""
    robot = Robot()
    robot.do(0.7, first)
    robot.do(22.0, second)
    if second != first and second != "rise":
        assert list(begun(robot.events))[-1] == second
    end = SEATED if second == "sit-down" else ROBOT.home
    np.testing.assert_allclose(robot.applied, end, atol=0.02)


def test_what_nothing_may_interrupt_is_brought_to_its_end() -> None:
    robot = Robot()
    robot.do(0.5, "kick-left")
    robot.do(12.0, "wave")
    assert [text for text in robot.events if "kick" in text] == ["'kick-left' begins", "'kick-left' is over"]
    robot = Robot()
    robot.do(0.5, "wave")
    robot.do(4.0, "kick-left")
    assert "'wave' is interrupted" in robot.events


def test_seated_it_stays_so_for_as_long_as_that_is_asked_for_and_rises_when_nothing_is() -> None:
    robot = Robot()
    robot.do(6.0, "sit-down")
    np.testing.assert_allclose(robot.applied, SEATED, atol=1e-6)
    robot.do(6.0, None)
    assert list(begun(robot.events)) == ["sit-down", "rise"]
    np.testing.assert_allclose(robot.applied, ROBOT.home, atol=1e-9)


def test_when_the_run_ends_a_seated_robot_stays_where_it_is_and_one_that_waves_stands() -> None:
    robot = Robot()
    robot.do(3.0, "sit-down")
    robot.do(1.5, None, stand=True)
    np.testing.assert_allclose(robot.applied, SEATED, atol=1e-6)
    robot = Robot()
    robot.do(3.0, "wave")
    robot.do(4.0, None, stand=True)
    assert robot.events[-1] == "'wave' is interrupted: the run ends"
    np.testing.assert_allclose(robot.applied, ROBOT.home, atol=1e-6)


def test_it_walks_between_skills_and_comes_to_rest_before_one() -> None:
    robot = Robot()
    robot.do(1.0, None, velocity=0.2)
    assert robot.stands.asked[-1].velocity[0] == 0.2
    robot.do(0.16, "wave", velocity=0.2)
    assert robot.stands.asked[-1].velocity[0] == 0.0
    assert list(begun(robot.events)) == [], "not while goals still move"
    robot.do(1.5, "wave", velocity=0.2)
    assert list(begun(robot.events)) == ["wave"]


def test_what_there_is_not_is_an_error_and_what_is_so_already_an_event() -> None:
    robot = Robot()
    with pytest.raises(ConfigError, match="unknown skill 'wav': did you mean 'wave'"):
        robot.do(0.1, "wav")
    robot = Robot()
    robot.do(0.1, "rise")
    assert robot.events == ["'rise' is not needed: the robot is upright"]

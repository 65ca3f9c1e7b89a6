"""A network that knows skills is told one at a time, each from its beginning, whatever is asked and when."""

from __future__ import annotations

from collections.abc import Mapping
from functools import cache

import numpy as np
import pytest
from task_bodies import state

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.robot.description import load_robot
from servoid.policy.text.captions import NAMES
from servoid.policy.text.encoder import load_encoder
from servoid.policy.text.told import UNDER_WAY
from servoid.stack.control.base import BasePolicy
from servoid.stack.skills.skill import Skill, load_skills
from servoid.stack.skills.telling import PAST_SECONDS, STOP_SECONDS, Teller, ToldPolicy

ROBOT = load_robot()
STAND, FORWARD = NAMES.index("stand"), NAMES.index("forward")
STOP = round(STOP_SECONDS / ROBOT.dt)


@cache
def skills() -> Mapping[str, Skill]:
    return {name: skill for name, skill in load_skills(ROBOT).items() if skill.alone}


def told(teller: Teller, asked: str | int, seconds: float) -> list[str | int]:
    """What is told while something is asked for, each once."""
    found: list[str | int] = []
    for _ in range(round(seconds / ROBOT.dt)):
        teller.tell(asked)
        if not found or found[-1] != teller.now:
            found.append(teller.now)
    return found


def test_a_skill_is_told_at_once_to_a_robot_that_stands_and_its_clock_runs_on_past_its_end_but_not_for_ever() -> None:
    teller = Teller(skills(), ROBOT.dt)
    teller.tell("nod")
    assert (teller.now, teller.since) == ("nod", 0.0)
    assert told(teller, "nod", 1.0) == ["nod"]
    assert teller.since == pytest.approx(1.0)
    told(teller, "nod", 9.0)
    assert teller.since == pytest.approx(skills()["nod"].seconds + PAST_SECONDS)  # as long as training told it


def test_a_robot_that_walks_is_told_to_stand_for_a_moment_before_a_skill() -> None:
    teller = Teller(skills(), ROBOT.dt)
    assert told(teller, FORWARD, 2.0) == [FORWARD]
    assert told(teller, "wave", STOP_SECONDS) == [STAND]
    assert told(teller, "wave", 1.0) == ["wave"]


def test_a_walk_has_a_clock_until_it_is_under_way() -> None:
    """Without it each plan of a robot that stands would begin the walk a moment later."""
    teller = Teller(skills(), ROBOT.dt)
    told(teller, FORWARD, 0.5)
    assert -UNDER_WAY < teller.since < 0.0
    told(teller, FORWARD, 1.0)
    assert teller.since == 0.0


def test_asked_to_stand_a_moment_ago_it_is_told_a_skill_no_sooner() -> None:
    teller = Teller(skills(), ROBOT.dt)
    told(teller, FORWARD, 2.0)
    told(teller, STAND, 0.2)
    assert told(teller, "wave", STOP_SECONDS - 0.3) == [STAND]
    assert told(teller, "wave", 1.0)[-1] == "wave"


def test_what_may_be_left_is_left_in_mid_motion_and_what_may_not_comes_to_its_end() -> None:
    teller = Teller(skills(), ROBOT.dt)
    told(teller, "wave", 2.0)
    assert told(teller, FORWARD, 1.0) == [FORWARD]
    told(teller, "kick-low-left", 2.0)
    kicking = skills()["kick-low-left"].seconds
    assert told(teller, FORWARD, kicking - 1.5) == ["kick-low-left"]
    assert told(teller, FORWARD, 1.0)[-1] == FORWARD


def test_a_robot_that_sits_rises_before_anything_else() -> None:
    teller = Teller(skills(), ROBOT.dt)
    assert told(teller, "sit-down", 4.0) == ["sit-down"]
    assert told(teller, FORWARD, 3.0) == ["rise", FORWARD]
    told(teller, "sit-down", 4.0)
    assert told(teller, "bow", 3.0) == ["rise", "bow"]
    assert told(teller, "rise", 3.0)[-1] == STAND  # it is up already


class Noting(BasePolicy):
    """Holds the pose, and remembers what it was asked."""

    def __init__(self) -> None:
        self.asked: list[Instruction] = []

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        self.asked.append(instruction)
        return applied


@pytest.fixture
def planner() -> Noting:
    return Noting()


def act(policy: ToldPolicy, instruction: Instruction, ticks: int = 1) -> None:
    for _ in range(ticks):
        policy.act(state(), ROBOT.home, instruction)


def test_sentences_become_those_of_the_training_with_a_clock(planner: Noting) -> None:
    policy = ToldPolicy(ROBOT, planner, skills(), load_encoder())
    act(policy, Instruction(np.zeros(3), text="please bow to the audience"), 3)
    last = planner.asked[-1]
    assert last.text in skills()["bow"].phrases
    assert last.since == pytest.approx(2 * ROBOT.dt)
    act(policy, Instruction(np.zeros(3), text="proceed forward"))
    assert planner.asked[-1].text == "proceed forward"
    assert planner.asked[-1].since == -UNDER_WAY  # of a walk that is to begin
    assert planner.asked[-1].velocity[0] > 0.0
    act(policy, Instruction(np.zeros(3), text="make me a sandwich"))
    assert planner.asked[-1].text == "proceed forward"
    assert any("sandwich" in event for event in policy.take_events())


def test_a_velocity_goes_through_as_it_is_and_a_skill_by_its_name_is_told_in_words(planner: Noting) -> None:
    policy = ToldPolicy(ROBOT, planner, skills(), load_encoder())
    asked = Instruction(np.array([0.1, 0.0, 0.2]))
    act(policy, asked)
    assert planner.asked[-1].velocity is asked.velocity
    assert planner.asked[-1].text is None
    act(policy, Instruction(np.zeros(3), skill="wave"), STOP + 2)
    assert planner.asked[1].text == "stand still"
    assert planner.asked[-1].text in skills()["wave"].phrases


def test_a_run_that_ends_does_not_leave_a_kick_half_done(planner: Noting) -> None:
    policy = ToldPolicy(ROBOT, planner, skills(), load_encoder())
    act(policy, Instruction(np.zeros(3), skill="kick-low-left"), 20)
    act(policy, Instruction(np.zeros(3), stand=True))
    assert planner.asked[-1].text in skills()["kick-low-left"].phrases
    assert not planner.asked[-1].stand
    act(policy, Instruction(np.zeros(3), stand=True), round(skills()["kick-low-left"].seconds * ROBOT.rate))
    assert planner.asked[-1].stand

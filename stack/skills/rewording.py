"""Sentences in the words that a policy was trained with."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import cached_property

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Adopted, Instruction, Policy, State
from servoid.hw.robot.description import Robot
from servoid.policy.text.encoder import load_encoder
from servoid.stack.control.base import BasePolicy
from servoid.stack.skills.skill import load_skills
from servoid.stack.skills.words import SkillWords


class RewordedPolicy(BasePolicy):
    """Tells a policy what a sentence asks for as its training said it. One that asks for no known walk or skill is told
    as it is, for the policy to read by the nearest that it knows: that alone takes "sidestep left" for a reach to the
    left side."""

    def __init__(self, robot: Robot, policy: Policy, sentences: Collection[str]) -> None:
        """`sentences` are those that the policy was trained with."""
        self._robot, self._policy, self._sentences = robot, policy, frozenset(sentences)
        self._heard: dict[str, str] = {}

    @cached_property
    def _words(self) -> SkillWords:
        return SkillWords(load_encoder(), load_skills(self._robot))

    def reworded(self, text: str) -> str:
        if text not in self._heard:
            self._heard[text] = text if text in self._sentences else self._words.said(text)
        return self._heard[text]

    @property
    def adopted(self) -> Adopted | None:
        return self._policy.adopted

    def reset(self, where: Array | None, seeds: Array) -> None:
        self._policy.reset(where, seeds)

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        if instruction.text is not None:
            instruction = replace(instruction, text=self.reworded(instruction.text))
        return self._policy.act(state, applied, instruction)

    def take_events(self) -> tuple[str, ...]:
        return self._policy.take_events()

    def repeat(self, plans: Mapping[int, int]) -> None:
        self._policy.repeat(plans)

    def close(self) -> None:
        self._policy.close()

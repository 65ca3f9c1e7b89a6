"""Sentences in the words that a policy was trained with."""

from __future__ import annotations

from collections.abc import Collection, Mapping
from dataclasses import replace
from functools import cached_property

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Adopted, Instruction, Policy, State
from servoid.hw.robot.description import Robot
from servoid.policy.diffusion.prefix.planning import led
from servoid.policy.text.captions import MOTIONS, twist_of
from servoid.policy.text.encoder import load_encoder
from servoid.stack.control.base import BasePolicy
from servoid.stack.skills.skill import load_skills
from servoid.stack.skills.words import SkillWords

_WALKS = {text: number for number, motion in enumerate(MOTIONS) for text in motion.phrasings}


class RewordedPolicy(BasePolicy):
    """Tells a planner what a sentence asks for as its training said it, and of a walk, besides, where that leads by the
    end of a plan: from standing, a sentence alone sets it turning without a step.

    A sentence that asks for no known walk or skill is told as it is, for the planner to read by the nearest that it
    knows: that alone takes "sidestep left" for a reach to the left side."""

    def __init__(self, robot: Robot, policy: Policy, sentences: Collection[str], seconds: float) -> None:
        """`sentences` are those that the policy was trained with; a plan that is asked for now ends in `seconds`."""
        self._robot, self._policy, self._sentences, self._seconds = robot, policy, frozenset(sentences), seconds
        self._heard: dict[str, tuple[str, dict[str, Array] | None]] = {}

    @cached_property
    def _words(self) -> SkillWords:
        return SkillWords(load_encoder(), load_skills(self._robot))

    def told(self, text: str) -> tuple[str, dict[str, Array] | None]:
        """A sentence as it is told, and with it targets, where it asks for a walk."""
        if text not in self._heard:
            self._heard[text] = self._told(text)
        return self._heard[text]

    def _told(self, text: str) -> tuple[str, dict[str, Array] | None]:
        asked: str | int
        if text in _WALKS:
            asked = _WALKS[text]
        elif text in self._sentences:
            return text, None
        else:
            try:
                asked = self._words.understand(text)
            except ConfigError:
                return text, None
        if isinstance(asked, str):
            return self._words.skills[asked].phrases[0], None
        said, twist = MOTIONS[asked].phrasings[0], twist_of(asked, self._robot.walking.scale)
        if not twist.any():
            return said, None
        place, turn = led(twist, self._seconds)
        return said, {"ground": place, "heading": turn}

    @property
    def adopted(self) -> Adopted | None:
        return self._policy.adopted

    def reset(self, where: Array | None, seeds: Array) -> None:
        self._policy.reset(where, seeds)

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        if instruction.text is not None:
            text, targets = self.told(instruction.text)
            instruction = replace(instruction, text=text, targets=instruction.targets or targets)
        return self._policy.act(state, applied, instruction)

    def take_events(self) -> tuple[str, ...]:
        return self._policy.take_events()

    def repeat(self, plans: Mapping[int, int]) -> None:
        self._policy.repeat(plans)

    def close(self) -> None:
        self._policy.close()

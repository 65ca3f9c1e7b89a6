"""What a network that knows skills is told at each tick, of what it is asked for; and the policy that tells it."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Adopted, Instruction, Policy, State
from servoid.hw.robot.description import Robot
from servoid.policy.text.captions import MOTIONS, NAMES, motion_of, twist_of
from servoid.policy.text.encoder import TextEncoder
from servoid.policy.text.told import walk_clock
from servoid.stack.control.base import BasePolicy
from servoid.stack.skills.skill import UPRIGHT, Skill, chosen, steps, way
from servoid.stack.skills.words import SkillWords

STOP_SECONDS = 0.8  # of standing, between a walk or a skill that is left half done and a skill
PAST_SECONDS = 1.4  # after a skill's end: longer than this no training saw it told
_STAND = NAMES.index("stand")


class Teller:
    """Of one robot. A skill is told once, from its beginning; told on, the robot stands.

    Before a skill a robot that moves is told to stand for a moment, and one that sits to rise. A skill that nothing may
    interrupt is told to its end.
    """

    def __init__(self, skills: Mapping[str, Skill], dt: float) -> None:
        """`skills` are those that may be told; a tick takes `dt` s."""
        self._skills, self._dt = skills, dt
        self.now: str | int = _STAND  # what is told: a skill's name, or a number in `MOTIONS`
        self._ticks = 0  # since it began
        self._stopping = False  # whether it is a stand that followed something else

    @property
    def since(self) -> float:
        """Seconds since a skill began, as training counted them; of a walk its clock (`walk_clock`)."""
        if isinstance(self.now, int):
            return float(walk_clock(np.array(self._ticks * self._dt)))
        return min(self._ticks * self._dt, self._skills[self.now].seconds + PAST_SECONDS)

    def tell(self, asked: str | int) -> None:
        """Go on by a tick, being asked for a skill by its name or for a walk. Raises ConfigError for an unknown one."""
        self._ticks += 1
        if asked != self.now:
            self._go_on(asked)

    @property
    def _over(self) -> bool:
        """Whether the skill that is told has come to its end."""
        return isinstance(self.now, str) and self._ticks * self._dt > self._skills[self.now].seconds

    def _go_on(self, asked: str | int) -> None:
        now = self._skills[self.now] if isinstance(self.now, str) else None
        if now is not None and not self._over and now.interrupted_by == "nothing":
            return
        here = UPRIGHT if now is None else now.end
        if isinstance(asked, int):
            rising = way(here, UPRIGHT, self._skills)
            self._begin(rising[0].name if rising else asked)
            return
        ahead = steps(here, chosen(asked, self._skills), self._skills)
        if not ahead:  # it leads to where the robot is
            if self.now != _STAND:
                self._begin(_STAND)
            return
        stands = self.now == _STAND and (not self._stopping or self._ticks * self._dt >= STOP_SECONDS)
        if self._over or stands:
            self._begin(ahead[0].name)
        elif self.now != _STAND:
            self._begin(_STAND)

    def _begin(self, what: str | int) -> None:
        self.now, self._ticks, self._stopping = what, 0, what == _STAND


class ToldPolicy(BasePolicy):
    """Tells a planner whose network knows skills what it is asked for by name, in words, or by a velocity."""

    def __init__(self, robot: Robot, planner: Policy, skills: Mapping[str, Skill], encoder: TextEncoder) -> None:
        """`skills` are those that the network knows."""
        self._robot, self._planner, self._skills = robot, planner, skills
        self._words = SkillWords(encoder, skills)
        self._heard: dict[str, str | int | None] = {}  # sentences, and what they ask for; None: for nothing known
        self._events: list[str] = []
        self._begin()

    def _begin(self) -> None:
        self._teller = Teller(self._skills, self._robot.dt)
        self._last: str | int = _STAND  # what was asked for last
        self._sentence, self._told = "", ""  # that asked for it; what is told

    @property
    def adopted(self) -> Adopted | None:
        return self._planner.adopted

    def reset(self, where: Array | None, seeds: Array) -> None:
        self._planner.reset(where, seeds)
        self._begin()

    def take_events(self) -> tuple[str, ...]:
        taken, self._events = (*self._planner.take_events(), *self._events), []
        return taken

    def repeat(self, plans: Mapping[int, int]) -> None:
        self._planner.repeat(plans)

    def close(self) -> None:
        self._planner.close()

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        """Raises ConfigError for a skill that the network does not know."""
        asked = self._asked(instruction)
        if asked is not None:
            self._last, self._sentence = asked, instruction.text or ""
        before = self._teller.now
        self._teller.tell(self._last)
        now = self._teller.now
        if now != before or not self._told:
            self._told = self._phrase(now)
            self._events.append(f"told: {self._told}")
        since = np.array(self._teller.since)
        if now == asked and instruction.text is None and instruction.skill is None:
            # A velocity, which says more than a sentence.
            return self._planner.act(state, applied, replace(instruction, since=since))
        velocity = twist_of(now, self._robot.walking.scale) if isinstance(now, int) else np.zeros(3)
        told = replace(
            instruction,
            velocity=velocity,
            text=self._told,
            since=since,
            stand=instruction.stand and now == _STAND,
        )
        return self._planner.act(state, applied, told)

    def _phrase(self, now: str | int) -> str:
        """How to tell it: a skill in its clearest phrase, a walk in the words of the sentence that asked for it."""
        if isinstance(now, str):
            return self._words.clearest(now)
        return self._sentence if now == self._last and self._sentence else MOTIONS[now].phrasings[0]

    def _asked(self, instruction: Instruction) -> str | int | None:
        """What is asked for; None: nothing that is understood, so what was asked for last."""
        if instruction.stand:
            return _STAND
        if instruction.skill is not None:
            return instruction.skill
        if instruction.text is None:
            return int(motion_of(instruction.velocity, self._robot.walking.scale))
        text = instruction.text
        if text not in self._heard:
            try:
                self._heard[text] = self._words.understand(text)
            except ConfigError as error:
                self._heard[text] = None
                self._events.append(f"{error}: what was asked for before goes on")
        return self._heard[text]

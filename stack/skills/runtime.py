"""The policy that performs skills: it goes from any one to any other, and stands or walks when none is asked for."""

from __future__ import annotations

from collections import deque
from collections.abc import Callable, Mapping
from dataclasses import replace

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Adopted, Instruction, Policy, State
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import smooth
from servoid.policy.references.clip import BLEND_SHARE
from servoid.stack.control.base import BasePolicy
from servoid.stack.safety.min_jerk import MIN_JERK_PEAK
from servoid.stack.skills.performers import Performer, perform
from servoid.stack.skills.skill import UPRIGHT, Skill, chosen, steps, way

STEADY_SECONDS = 0.3  # that goals stay where they are, before a skill begins
STEADY_RANGE = 0.05  # rad: more than that, a foot is up in a step
PATIENCE_SECONDS = 1.5  # to come to rest in, as the guard has it: a walk that never rests shall not wait for ever


class SkillPolicy(BasePolicy):
    """Performs what `Instruction.skill` names, once for each time that it is asked; `between` controls a robot that
    performs nothing, and is asked to stand from when a skill is asked for.

    Skills meet in poses: before one, those that lead to its entry are performed. A robot that was brought down by a
    skill stays down for as long as that is asked for, or the run ends, and then gets up. A skill that nothing may
    interrupt is brought to its end first. `between` acts at every tick, so that its own history has no gap.
    """

    def __init__(
        self,
        robot: Robot,
        between: Policy,
        skills: Mapping[str, Skill],
        performer: Callable[[Skill, Robot], Performer] = perform,
    ) -> None:
        self._robot, self._between, self._skills = robot, between, skills
        self._make, self._performers = performer, dict[str, Performer]()
        self._events: list[str] = []
        self._goals: deque[Array] = deque(maxlen=round(STEADY_SECONDS * robot.rate))  # of the last ticks between skills
        self._begin()

    def _begin(self) -> None:
        self._pose = UPRIGHT  # that the last skill ended in
        self._asked: str | None = None
        self._now: Skill | None = None  # that is performed
        self._ahead: deque[Skill] = deque()
        self._goals.extend([self._robot.home] * (self._goals.maxlen or 0))  # a run begins at rest
        self._waited = 0
        self._entering = False  # from a skill's last pose, into what `between` wants
        self._offset, self._since, self._blend = np.zeros(len(self._robot.joints)), 0, 1

    @property
    def adopted(self) -> Adopted | None:
        return self._between.adopted

    def reset(self, where: Array | None, seeds: Array) -> None:
        self._between.reset(where, seeds)
        self._begin()

    def take_events(self) -> tuple[str, ...]:
        taken, self._events = (*self._between.take_events(), *self._events), []
        return taken

    def repeat(self, plans: Mapping[int, int]) -> None:
        self._between.repeat(plans)

    def close(self) -> None:
        self._between.close()

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        """Raises ConfigError for an unknown skill, and for one that nothing leads to."""
        if instruction.stand:
            self._stop()
        elif instruction.skill != self._asked:
            self._asked = instruction.skill
            self._ask(instruction.skill)
        elif self._asked is None and self._down and not self._ahead:
            self._ahead.extend(way(self._pose, UPRIGHT, self._skills))
        walks = self._now is None and not self._ahead and not self._down
        told = replace(instruction, skill=None) if walks else Instruction(np.zeros(3), stand=True)
        between = self._between.act(state, applied, told)
        if self._now is None and self._ahead and self._may_begin():
            self._perform(self._ahead.popleft())
        if self._now is not None:
            return self._go_on(self._now, state, applied)
        return applied if self._down else self._stand(applied, between)

    @property
    def _down(self) -> bool:
        """Whether the last skill has brought the robot down."""
        return self._now is None and self._pose != UPRIGHT

    def _stop(self) -> None:
        """Begin nothing more, and leave what may be left."""
        self._ahead.clear()
        if self._now is not None and self._now.interrupted_by == "anything":
            self._leave("is interrupted: the run ends")

    def _ask(self, name: str | None) -> None:
        """Lay out the way to what is asked for now, from where the robot will be when it may leave what it does."""
        self._ahead.clear()
        self._waited = 0
        if self._now is not None and self._now.interrupted_by == "anything":
            self._leave("is interrupted")
        if name is None:
            return
        skill = chosen(name, self._skills)
        here = self._pose if self._now is None else self._now.end
        self._ahead.extend(steps(here, skill, self._skills))
        if not self._ahead:
            self._events.append(f"'{name}' is not needed: the robot is {here}")

    def _may_begin(self) -> bool:
        """Whether a robot that is upright has come to rest, or had its time; elsewhere it rests already."""
        self._waited += 1
        if self._down or self._waited > PATIENCE_SECONDS * self._robot.rate:
            return True
        return len(self._goals) == self._goals.maxlen and float(np.ptp(self._goals, axis=0).max()) < STEADY_RANGE

    def _perform(self, skill: Skill) -> None:
        if skill.name not in self._performers:
            self._performers[skill.name] = self._make(skill, self._robot)
        self._performers[skill.name].reset(None, np.zeros((), int))
        self._now, self._waited = skill, 0
        self._events.append(f"'{skill.name}' begins")

    def _go_on(self, skill: Skill, state: State, applied: Array) -> Array:
        performer = self._performers[skill.name]
        target = performer.act(state, applied, Instruction(np.zeros(3)))
        if performer.ended:
            self._pose = skill.end
            self._leave("is over")
        return target

    def _leave(self, how: str) -> None:
        assert self._now is not None
        self._events.append(f"'{self._now.name}' {how}")
        self._now, self._entering = None, True
        self._goals.clear()

    def _stand(self, applied: Array, between: Array) -> Array:
        """What `between` wants, the pose that a skill left behind fading out of it."""
        if self._entering:
            self._entering, self._offset, self._since = False, applied - between, 0
            speed = BLEND_SHARE * self._robot.limits.joint_speed * self._robot.dt
            self._blend = max(int(np.ceil(MIN_JERK_PEAK * np.abs(self._offset).max() / speed)), 1)
        self._since += 1
        goal = between + (1.0 - smooth(np.asarray(self._since / self._blend))) * self._offset
        self._goals.append(goal)
        return goal

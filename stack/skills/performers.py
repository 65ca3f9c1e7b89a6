"""What performs a skill, by the word in its file: a clip's goals alone, or a tracker of the clip."""

from __future__ import annotations

from collections.abc import Callable
from typing import Protocol

from servoid.hw.config import ConfigError
from servoid.hw.contracts.control import Policy
from servoid.hw.robot.description import Robot
from servoid.stack.control.clip import ClipPolicy, TrackedClip
from servoid.stack.control.tracker import Tracker
from servoid.stack.skills.skill import Skill, clip_of


class Performer(Policy, Protocol):
    """A policy that comes to an end."""

    @property
    def ended(self) -> bool:
        """Whether the motion is over: what it wants from then on is its last pose."""
        ...


def _clip(skill: Skill, robot: Robot) -> Performer:
    return ClipPolicy(robot, clip_of(skill, robot), balance=skill.balance)


def _tracker(skill: Skill, robot: Robot) -> Performer:
    try:
        tracker = Tracker(robot, skill.tracker, clips=True)
    except ConfigError as error:
        raise ConfigError(f"skill '{skill.name}': policy: tracker: {error}: write policy: clip") from error
    return TrackedClip(robot, clip_of(skill, robot), tracker)


PERFORMERS: dict[str, Callable[[Skill, Robot], Performer]] = {"clip": _clip, "tracker": _tracker}


def perform(skill: Skill, robot: Robot) -> Performer:
    """What performs a skill. Raises ConfigError where it cannot be made."""
    return PERFORMERS[skill.policy](skill, robot)

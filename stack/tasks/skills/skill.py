"""Perform skills, by their names or by sentences, one after another."""

from __future__ import annotations

import math
from dataclasses import dataclass
from functools import cached_property
from typing import Annotated, Literal

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Criterion, Episode, Trace
from servoid.hw.contracts.world import Percept
from servoid.hw.robot.description import Robot, shipped_robot
from servoid.hw.setting import Setting
from servoid.policy.text.captions import NAMES
from servoid.policy.text.encoder import load_encoder
from servoid.stack.skills.skill import UPRIGHT, Skill, chosen, clip_of, load_skills, steps
from servoid.stack.skills.words import SkillWords
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, Settings

ANY = "any"
REST_SECONDS = 2.0  # after a skill: to come back to standing, and to stand
LEAVE_SECONDS = 1.5  # to come to rest from a skill that is broken off, before the next one
STILL_SECONDS, STILL_SPEED = 0.5, 0.05  # at the end: m/s of the base that count as standing still
STANDS, SITS = 0.8, 0.7  # of the standing height: at least, and at most


@dataclass(frozen=True)
class SkillSettings(Settings):
    seconds: Annotated[float, Setting("length of an episode at most: it ends when all is done", "s", above=0)] = 60.0
    name: Annotated[str | None, Setting("skills, one after another, separated by commas; any: one that is drawn")] = (
        None
    )
    text: Annotated[str | None, Setting("the same in sentences, separated by semicolons")] = None
    asked_by: Annotated[
        Literal["name", "training", "held_out"],
        Setting("what asks for the skills of `name`: that, or a sentence drawn from the skill's phrases or held_out"),
    ] = "name"
    every: Annotated[
        float | None, Setting("time from asking for one to the next; none: when it should be done", "s", above=0)
    ] = None

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.name is not None and self.text is not None:
            raise ValueError("name, text: give one of them")
        if self.text is not None and self.asked_by != "name":
            raise ValueError("asked_by: text is a sentence already; this goes with name")


@dataclass(frozen=True, kw_only=True)
class Asked(Episode):
    meant: tuple[str, ...]  # names of skills
    sentences: tuple[str, ...]  # that ask for them; empty where names do
    skills: tuple[str, ...]  # as they were understood
    begins: tuple[int, ...]  # ticks at which they are asked for,
    ends: int  # and at which the last one should be done
    performs: bool  # whether the last one takes a motion: one that only leads to where the robot is does not


class PerformSkills(BaseTask):
    name = "skill"
    description = "perform skills by name or in words: kick, wave, sit down"
    settings_type = SkillSettings
    performs = True
    guided_by_velocity_alone = True

    def __init__(self, settings: SkillSettings, dt: float, robot: Robot | None = None) -> None:
        """Raises ConfigError for a skill that there is not, or a sentence that asks for none."""
        super().__init__(settings, dt, robot)
        self._robot = robot or shipped_robot()
        self._clips: dict[str, Array] = {}
        for name in _listed(settings.name, ","):
            if name != ANY:
                chosen(name, self.skills)
        self._told = [(text, self._skill_of(text)) for text in _listed(settings.text, ";")]

    @cached_property
    def skills(self) -> dict[str, Skill]:
        return load_skills(self._robot)

    @cached_property
    def words(self) -> SkillWords:
        return SkillWords(load_encoder(), self.skills)

    def _goals(self, skill: Skill) -> Array:
        """Joint positions `(ticks, n_joints)` rad of a skill's clip."""
        if skill.name not in self._clips:
            self._clips[skill.name] = clip_of(skill, self._robot).joints
        return self._clips[skill.name]

    def _skill_of(self, text: str) -> str:
        found = self.words.understand(text)
        if isinstance(found, int):
            raise ConfigError(f"'{text}' asks to walk ({NAMES[found]}): use servoid run text --set sentence='{text}'")
        return found

    def scenario(self, rng: np.random.Generator) -> Asked:
        """Draw what is left open. Raises ConfigError where no skill is named, or a drawn sentence is misunderstood
        as one that asks to walk."""
        s = self.settings
        meant = [str(rng.choice(sorted(self.skills))) if name == ANY else name for name in _listed(s.name, ",")]
        sentences: tuple[str, ...] = ()
        asked = list(meant)
        if s.asked_by != "name":
            known = [
                self.skills[name].phrases if s.asked_by == "training" else self.skills[name].held_out for name in meant
            ]
            sentences = tuple(str(rng.choice(choices)) for choices in known)
            asked = [self._heard(text) for text in sentences]
        if self._told:
            sentences, asked = tuple(text for text, _ in self._told), [name for _, name in self._told]
            meant = asked
        if not asked:
            raise ConfigError("no skill is named: give --set name=wave or --set text='wave'; servoid skills lists them")
        begins, pose, before = [0], UPRIGHT, UPRIGHT
        for name in asked:
            begins.append(begins[-1] + self.ticks(s.every or self._lasts(pose, name)))
            before, pose = pose, self.skills[name].end if name in self.skills else pose
        last = self.skills.get(asked[-1])
        return Asked(
            meant=tuple(meant),
            sentences=sentences,
            skills=tuple(asked),
            begins=tuple(begins[:-1]),
            ends=begins[-2] + self.ticks(self._lasts(before, asked[-1]) + (LEAVE_SECONDS if s.every else 0.0)),
            performs=last is not None and bool(steps(before, last, self.skills)),
            told=tuple(name for name in asked if name),
            low=any(self.skills[name].low for name in asked if name in self.skills),
        )

    def _heard(self, text: str) -> str:
        """The skill that a drawn sentence is taken for; nothing where it is refused: that is a figure, and no error."""
        try:
            return self._skill_of(text)
        except ConfigError:
            return ""

    def _lasts(self, pose: str, name: str) -> float:
        """How long it should take [s] to perform a skill from a pose."""
        if name not in self.skills:
            return REST_SECONDS
        whole = steps(pose, self.skills[name], self.skills)
        return max(sum(part.seconds + REST_SECONDS for part in whole), REST_SECONDS)

    def behaviour(self, episode: Asked) -> BaseBehaviour:
        return _Ask(episode)

    def criteria(self, trace: Trace, episode: Asked) -> list[Criterion]:
        """Never fallen, understood, performed, and what must be true after the last of the skills."""
        found = [
            Criterion.never("fell", trace.fallen),
            Criterion.never("ended before it was done", len(trace.yaw) < episode.ends),
            Criterion.never("misunderstood", episode.skills != episode.meant),
        ]
        last = self.skills.get(episode.skills[-1])
        if last is None or len(trace.yaw) < episode.ends:
            return found
        if episode.performs:
            error = self._joint_error(trace, episode)
            found.append(Criterion("joints off the motion, root mean square", error, "rad", most=last.after.joints))
        height = float(trace.displacement[-1, 2]) / self._robot.standing_height
        least, most = (STANDS, math.inf) if last.end == UPRIGHT else (0.0, SITS)
        found += [
            Criterion("height at the end, of the standing height", height, least=least, most=most),
            Criterion("speed of the base at the end", self._speed(trace), "m/s", most=STILL_SPEED),
            Criterion("distance moved", self._moved(trace, episode), "m", most=last.after.moved),
            Criterion("angle turned", self._turned(trace, episode), "rad", most=last.after.turned),
        ]
        return found

    def metrics(self, trace: Trace, episode: Asked) -> dict[str, float]:
        done = len(trace.yaw) > episode.begins[-1]
        return {
            "understood": float(episode.skills == episode.meant),
            "joint_rms_rad": self._joint_error(trace, episode),
            "moved_m": self._moved(trace, episode) if done else float("nan"),
            "turned_rad": self._turned(trace, episode) if done else float("nan"),
        }

    def _speed(self, trace: Trace) -> float:
        """Mean planar speed at the end, from places: what sways about its place stands."""
        ticks = self.ticks(STILL_SECONDS)
        way = trace.displacement[-1, :2] - trace.displacement[-ticks, :2]
        return float(np.linalg.norm(way)) / STILL_SECONDS

    def _moved(self, trace: Trace, episode: Asked) -> float:
        way = trace.displacement[-1, :2] - trace.displacement[episode.begins[-1], :2]
        return float(np.linalg.norm(way))

    def _turned(self, trace: Trace, episode: Asked) -> float:
        return float(abs(trace.yaw[-1] - trace.yaw[episode.begins[-1]]))

    def _joint_error(self, trace: Trace, episode: Asked) -> float:
        """Root mean square [rad] of what the joints are off the goals of the last skill's clip, over all joints and
        its whole length, at the shift in time at which it is smallest: when it began, only the policy knows."""
        last = self.skills.get(episode.skills[-1])
        if last is None or trace.joints is None or not episode.performs:
            return float("nan")
        goals = self._goals(last)
        first = episode.begins[-1]
        until = min(episode.ends, len(trace.joints)) - len(goals) + 1
        errors = [
            float(np.sqrt(np.mean((trace.joints[at : at + len(goals)] - goals) ** 2))) for at in range(first, until)
        ]
        return min(errors, default=float("nan"))


class _Ask(BaseBehaviour):
    """Asks for each skill until just before the next: what is asked for twice is done twice."""

    def __init__(self, episode: Asked) -> None:
        super().__init__(episode)
        self._tick = 0

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        self._tick, asked = tick, self.episode
        number = int(np.searchsorted(asked.begins, tick, side="right")) - 1
        between = number + 1 < len(asked.begins) and tick == asked.begins[number + 1] - 1
        return Instruction(velocity=np.zeros(3), skill=None if between else asked.skills[number] or None)

    def done(self, state: State) -> bool:
        return self._tick >= self.episode.ends


def _listed(text: str | None, separator: str) -> list[str]:
    return [part.strip() for part in (text or "").split(separator) if part.strip()]

"""Do what a sentence says; the sentence changes every few seconds, in mid motion. It is about walking, or a skill."""

from __future__ import annotations

import math
from collections.abc import Sequence
from dataclasses import dataclass, field
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
from servoid.policy.references.gait import load_gait
from servoid.policy.text.captions import MOTIONS, followed, twist_of
from servoid.stack.skills.skill import UPRIGHT, Skill, clip_of, load_skills
from servoid.stack.tasks.base import BaseBehaviour, BaseTask, Settings
from servoid.stack.tasks.terms import metrics as measures
from servoid.stack.tasks.terms.likeness import SeenMotion, performed


@dataclass(frozen=True)
class TextSettings(Settings):
    every: Annotated[float, Setting("time between changes of the sentence", "s", above=0)] = 5.0
    settle: Annotated[float, Setting("time after each change that does not count", "s", least=0)] = measures.SETTLING
    phrasings: Annotated[Literal["held_out", "training"], Setting("held_out (which no training saw) or training")] = (
        "held_out"
    )
    sentence: Annotated[str | None, Setting("what to do all the time, instead of sentences drawn")] = None
    about: Annotated[
        Literal["walks", "skills", "both"],
        Setting("what drawn sentences ask for; skills need --policy skills"),
    ] = "walks"
    cycle: Annotated[
        float, Setting("length of a gait cycle: motion is measured over whole ones", "s", above=0, of="cycle")
    ] = field(default_factory=lambda: load_gait().cycle)

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.settle > self.every - self.cycle:
            raise ValueError(f"settle: {self.settle:g} leaves no gait cycle of every ({self.every:g})")


@dataclass(frozen=True, kw_only=True)
class Sentences(Episode):
    motions: tuple[int | str, ...]  # numbers in MOTIONS, or names of skills
    sentences: tuple[str, ...]


class Text(BaseTask):
    name = "text"
    description = "do what a sentence says; it changes every few seconds"
    settings_type = TextSettings
    counts_undone = ("followed_share",)
    guided_by_velocity_alone = True

    def __init__(self, settings: TextSettings, dt: float, robot: Robot | None = None) -> None:
        """Raises ConfigError for a sentence that names no motion."""
        super().__init__(settings, dt, robot)
        self._asked = None if settings.sentence is None else self._understood(settings.sentence)

    @cached_property
    def skills(self) -> dict[str, Skill]:
        """Skills that sentences may ask for: those that take nothing but the ground."""
        return {name: skill for name, skill in load_skills(self.robot or shipped_robot()).items() if skill.alone}

    @cached_property
    def shown(self) -> dict[str, SeenMotion]:
        """What each of them looks like."""
        robot = self.robot or shipped_robot()
        clips = {name: clip_of(skill, robot).joints for name, skill in self.skills.items()}
        return {
            name: SeenMotion(j, robot.home if self.skills[name].end == UPRIGHT else j[-1]) for name, j in clips.items()
        }

    def _understood(self, sentence: str) -> int | str:
        from servoid.policy.text.encoder import load_encoder
        from servoid.stack.skills.words import SkillWords

        try:
            return SkillWords(load_encoder(), self.skills).understand(sentence)
        except ConfigError as error:
            raise ConfigError(f"--set sentence={sentence}: {error}") from None

    def scenario(self, rng: np.random.Generator) -> Sentences:
        """Draw motions, each another one than before, and a sentence for each."""
        s = self.settings
        motions: list[int | str] = []
        sentences: list[str] = []
        for _ in range(math.ceil(self.seconds / s.every)):
            last = motions[-1] if motions else None
            others = [motion for motion in self._choices(last) if motion != last]
            motion = others[int(rng.integers(len(others)))]
            known = self.skills[motion] if isinstance(motion, str) else MOTIONS[motion]
            choices = known.held_out
            if s.phrasings == "training":
                choices = known.phrases if isinstance(known, Skill) else known.phrasings
            sentence = choices[rng.integers(len(choices))]
            if self._asked is not None and s.sentence is not None:
                motion, sentence = self._asked, s.sentence
            motions.append(motion)
            sentences.append(sentence)
        told = tuple(dict.fromkeys(motion for motion in motions if isinstance(motion, str)))
        low = any(self.skills[name].low for name in told)
        return Sentences(motions=tuple(motions), sentences=tuple(sentences), told=told, low=low)

    def _choices(self, last: int | str | None) -> list[int | str]:
        """What may be asked for after `last`: a skill that begins upright, or as the last one ended."""
        walks: list[int | str] = list(range(len(MOTIONS)))
        if self.settings.about == "walks":
            return walks
        pose = self.skills[last].end if isinstance(last, str) else UPRIGHT
        skills: list[int | str] = [name for name, skill in self.skills.items() if skill.entry in (UPRIGHT, pose)]
        return skills if self.settings.about == "skills" else [*walks, *skills]

    def behaviour(self, episode: Sentences) -> BaseBehaviour:
        return _Tell(episode, self.ticks(self.settings.every), self.top)

    def criteria(self, trace: Trace, episode: Sentences) -> list[Criterion]:
        """Never fallen, and every sentence followed."""
        share = self._followed(trace, episode)
        return [Criterion.never("fell", trace.fallen), Criterion("share of sentences followed", share, least=1.0)]

    def metrics(self, trace: Trace, episode: Sentences) -> dict[str, float]:
        return {"followed_share": self._followed(trace, episode)}

    def _followed(self, trace: Trace, episode: Sentences) -> float:
        """Share of the sentences that the mean measured motion followed; NaN where the task is too short to tell.

        A sentence that got no gait cycle was not followed, but where the run ended by its time.
        """
        verdicts = self.verdicts(trace, episode.motions)
        return float(np.mean(verdicts)) if verdicts else float("nan")

    def verdicts(self, trace: Trace, motions: Sequence[int | str]) -> list[bool]:
        """Whether each of the motions that were asked for, one after another, was done, as far as that can be told."""
        every, cycle = round(self.settings.every / self.dt), round(self.settings.cycle / self.dt)
        in_time = not trace.fallen and len(trace.yaw) >= round(self.seconds / self.dt)
        verdicts, top = [], self.top
        for number, motion in enumerate(motions):
            if isinstance(motion, str):
                ticks = slice(number * every, (number + 1) * every)
                if trace.joints is not None and len(trace.yaw) >= ticks.stop:
                    home = (self.robot or shipped_robot()).home
                    verdicts.append(performed(motion, trace.joints[ticks], self.shown, home, self.dt))
                elif not in_time:
                    verdicts.append(False)
                continue
            first = number * every + round(self.settings.settle / self.dt)
            cycles = (min((number + 1) * every, len(trace.yaw)) - first) // cycle
            if cycles >= 1:
                rows = slice(first, first + cycles * cycle)
                twist = np.array([*trace.velocity[rows, :2].mean(0), trace.yaw_rate[rows].mean()])
                verdicts.append(followed(motion, twist, top))
            elif not in_time:
                verdicts.append(False)
        return verdicts


class _Tell(BaseBehaviour):
    def __init__(self, episode: Sentences, ticks: int, top: Array) -> None:
        super().__init__(episode)
        self._ticks, self._top = ticks, top

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        """The sentence; with it the motion's typical velocity, for policies that do not read."""
        number = min(tick // self._ticks, len(self.episode.motions) - 1)
        motion = self.episode.motions[number]
        velocity = np.zeros(3) if isinstance(motion, str) else twist_of(motion, self._top)
        return Instruction(velocity=velocity, text=self.episode.sentences[number])


def understood(name: str, sentence: str) -> int:
    """Number of the motion that the setting `name` asks for. Raises ConfigError where that is in no known words."""
    from servoid.policy.text.encoder import load_encoder
    from servoid.policy.text.nearest_phrase import Phrasebook
    from servoid.stack.skills.skill import load_skills
    from servoid.stack.skills.words import SkillWords

    try:
        encoder = load_encoder()
        if SkillWords(encoder, load_skills(shipped_robot())).about_skill(sentence):
            raise ConfigError(f"'{sentence}' asks for a skill: use servoid run skill --set text='{sentence}'")
        return Phrasebook(encoder).understand(sentence)
    except ConfigError as error:
        raise ConfigError(f"--set {name}={sentence}: {error}") from None

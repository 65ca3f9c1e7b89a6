"""Do what a sentence says; the sentence changes every few seconds."""

from __future__ import annotations

import math
from dataclasses import dataclass
from typing import Annotated, Literal

import numpy as np

from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Trace
from servoid.hw.contracts.world import Percept
from servoid.policy.text.captions import MOTIONS, followed, twist_of
from servoid.stack.tasks import metrics as measures
from servoid.stack.tasks.base import BaseTask, Settings, require_positive
from servoid.stack.tasks.sentences import require_words, understood


@dataclass(frozen=True)
class TextSettings(Settings):
    every: Annotated[float, "s between changes of the sentence"] = 5.0
    settle: Annotated[float, "s after each change that do not count"] = measures.SETTLING
    phrasings: Annotated[Literal["held_out", "training"], "held_out, which no training saw, or training"] = "held_out"
    sentence: Annotated[str | None, "says what to do all the time, instead of sentences that are drawn"] = None
    cycle: Annotated[float, "s, length of a gait cycle, over whole ones of which motion is measured"] = 0.48

    def __post_init__(self) -> None:
        super().__post_init__()
        require_positive(self, "every", "cycle")
        if not 0.0 <= self.settle <= self.every - self.cycle:
            raise ValueError(f"settle: {self.settle:g} leaves no gait cycle of every ({self.every:g})")


class Text(BaseTask):
    name = "text"
    description = "do what a sentence says; it changes every few seconds"
    settings_type = TextSettings
    counts_undone = ("followed_share",)

    def __init__(self, settings: TextSettings, dt: float) -> None:
        """Raises ConfigError for a sentence that names no motion."""
        super().__init__(settings, dt)
        self._asked: int | None = None if settings.sentence is None else understood("sentence", settings.sentence)

    @staticmethod
    def complete(settings: dict[str, str]) -> dict[str, str]:
        """Raises ConfigError for a sentence without a word."""
        require_words(settings, "sentence")
        return settings

    def reset(self, rng: np.random.Generator) -> None:
        """Draw motions, each another one than before, and a sentence for each."""
        self._motions: list[int] = []
        self._sentences: list[str] = []
        for _ in range(math.ceil(self.seconds / self.settings.every)):
            others = [i for i in range(len(MOTIONS)) if not self._motions or i != self._motions[-1]]
            motion = others[int(rng.integers(len(others)))]
            choices = MOTIONS[motion].held_out if self.settings.phrasings == "held_out" else MOTIONS[motion].phrasings
            sentence = choices[rng.integers(len(choices))]
            if self._asked is not None:
                motion, sentence = self._asked, self.settings.sentence
            self._motions.append(motion)
            self._sentences.append(sentence)

    def instruct(self, tick: int, state: State, percept: Percept) -> Instruction:
        """The sentence; with it the motion's typical velocity, for policies that do not read."""
        number = min(tick // max(round(self.settings.every / self.dt), 1), len(self._motions) - 1)
        return Instruction(velocity=twist_of(self._motions[number]), text=self._sentences[number])

    @property
    def guides(self) -> bool:
        """By the velocity alone, there being nothing else in its instructions."""
        return self.settings.cost.twist

    def success(self, trace: Trace) -> bool:
        """Never fallen, and every sentence followed."""
        return not trace.fallen and self._followed(trace) == 1.0

    def metrics(self, trace: Trace) -> dict[str, float]:
        return {"followed_share": self._followed(trace)}

    def _followed(self, trace: Trace) -> float:
        """Share of the sentences that the mean measured motion followed; NaN where the task is too short to tell.

        A sentence that got no gait cycle was not followed, but where the run ended by its time.
        """
        every, cycle = round(self.settings.every / self.dt), round(self.settings.cycle / self.dt)
        in_time = not trace.fallen and len(trace.yaw) >= round(self.seconds / self.dt)
        verdicts = []
        for number, motion in enumerate(self._motions):
            first = number * every + round(self.settings.settle / self.dt)
            cycles = (min((number + 1) * every, len(trace.yaw)) - first) // cycle
            if cycles >= 1:
                rows = slice(first, first + cycles * cycle)
                twist = np.array([*trace.velocity[rows, :2].mean(0), trace.yaw_rate[rows].mean()])
                verdicts.append(followed(motion, twist))
            elif not in_time:
                verdicts.append(False)
        return float(np.mean(verdicts)) if verdicts else float("nan")

"""Which skill a sentence asks for, or that it is about walking; and an error that helps where it is about neither."""

from __future__ import annotations

from collections.abc import Mapping

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.policy.text.captions import MOTIONS
from servoid.policy.text.encoder import TextEncoder
from servoid.policy.text.lexicon import words
from servoid.policy.text.nearest_phrase import FAMILIAR, Phrasebook, refuse_untold, side_of, similarity
from servoid.stack.skills.skill import Skill

# Cosine similarity to a phrase below which a text that names no skill asks for none: more than for walking, since there
# are many skills, and what is performed by mistake may throw the robot over. And by how much more it must be like a
# skill than like a walk.
SURE, MARGIN = 0.55, 0.02
# Parts of skills' names that other sentences have too.
_NO_NAME = {
    "left",
    "right",
    "up",
    "down",
    "front",
    "back",
    "forward",
    "around",
    "side",
    "high",
    "low",
    "both",
    "one",
    "two",
}
_NO_NAME |= {"ready", "on", "from", "seat", "foot", "stand", "look"}


class SkillWords:
    """The phrases of skills beside those of walking, in an encoder's codes."""

    def __init__(self, encoder: TextEncoder, skills: Mapping[str, Skill]) -> None:
        self._encoder, self._skills, self._walking = encoder, skills, Phrasebook(encoder)
        pairs = [(name, text) for name, skill in skills.items() for text in skill.phrases]
        self._names = np.array([name for name, _ in pairs])
        self._texts = [text for _, text in pairs]
        self._sides = np.array([side_of(text) for _, text in pairs])
        self._codes = encoder.encode([text for _, text in pairs])

    def understand(self, text: str) -> str | int:
        """Name of a skill, or index in `MOTIONS` of a way to walk.

        Raises ConfigError for what is neither, for a skill to a side that is not named, and as
        `Phrasebook.understand` does.
        """
        code = self._encoder.encode([text])
        near, walking = similarity(code, self._codes)[0], similarity(code, self._walking.codes)[0]
        named = self._named(text)
        if named.any():
            near = np.where(named, near, -np.inf)
        elif _walks(near.max(), walking.max()):
            return self._walking.understand(text)
        refuse_untold(text)
        name, side = str(self._names[near.argmax()]), side_of(text)
        if near.max() < SURE and not named.any():
            motion = MOTIONS[int(self._walking.motions[walking.argmax()])]
            raise ConfigError(
                f"the instruction '{text}' asks for nothing that is known; the nearest skill is "
                f"'{self._skills[name].phrases[0]}', the nearest motion '{motion.phrasings[0]}'"
            )
        if self._sides[near.argmax()] and not side:
            raise ConfigError(f"the instruction '{text}' does not say with which side; add 'left' or 'right'")
        fitting = np.where(self._sides == side, near, -np.inf)
        if not np.isfinite(fitting.max()):
            raise ConfigError(
                f"the instruction '{text}' says '{side}', but '{name}' has no side to choose: leave it out"
            )
        return str(self._names[fitting.argmax()])

    def phrase(self, name: str, text: str = "") -> str:
        """The phrase of a skill that is nearest to a text that asks for it; the first one without a text."""
        rows = np.flatnonzero(self._names == name)
        if not text:
            return self._texts[rows[0]]
        return self._texts[rows[similarity(self._encoder.encode([text]), self._codes[rows])[0].argmax()]]

    def about_skill(self, text: str) -> bool:
        """Whether a text is about a skill rather than about walking, understood or not. Raises ConfigError for one
        without a word."""
        code = self._encoder.encode([text])
        near, walking = similarity(code, self._codes).max(), similarity(code, self._walking.codes).max()
        return bool(self._named(text).any() or (near >= SURE and not _walks(near, walking)))

    def _named(self, text: str) -> Array:
        """Which phrases `(n,)` are of skills whose name has a word of the text: what kicks is no way to walk."""
        found = set(words(text)) - _NO_NAME
        return np.array([bool(found & set(name.split("-"))) for name in self._names])


def _walks(near: float, walking: float) -> bool:
    """Whether a text that names no skill is about walking, by its similarity to phrases of skills and of walks."""
    return walking >= FAMILIAR and near < walking + MARGIN

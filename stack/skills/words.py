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
# By how much more a text is like a skill, or a walk, whose phrases have all its telling words. Chosen on the phrases of
# skills, each read by the others: 43 of 190 were taken for another skill, and 54 without it.
SHARED = 0.2
# Words that tell nothing.
_EMPTY = {"the", "your", "a", "to", "with", "and", "in", "on", "of", "at", "it", "is", "my", "me", "us", "you"}
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
        self._encoder, self.skills, self._walking = encoder, skills, Phrasebook(encoder)
        pairs = [(name, text) for name, skill in skills.items() for text in skill.phrases]
        self._names = np.array([name for name, _ in pairs])
        self._texts = [text for _, text in pairs]
        self._sides = np.array([side_of(text) for _, text in pairs])
        walks = [(str(number), text) for number, motion in enumerate(MOTIONS) for text in motion.phrasings]
        self._known: dict[str, set[str]] = {}  # words by what they are said of
        for name, text in (*pairs, *walks):
            self._known.setdefault(name, set()).update(set(words(text)) - _EMPTY)
        self._codes = encoder.encode([text for _, text in pairs])

    def understand(self, text: str) -> str | int:
        """Name of a skill, or index in `MOTIONS` of a way to walk.

        Raises ConfigError for what is neither, for a skill to a side that is not named, and as
        `Phrasebook.understand` does.
        """
        alike, walking = self._alike(text)
        shared = self._shared(text)
        near = alike + SHARED * np.array([shared[name] for name in self._names])
        named = self._named(text)
        if named.any():
            near = np.where(named, near, -np.inf)
        elif self._walks(text):
            return self._walking.understand(text)
        refuse_untold(text)
        name, side = str(self._names[near.argmax()]), side_of(text)
        if alike.max() < SURE and not named.any():
            motion = MOTIONS[int(self._walking.motions[walking.argmax()])]
            raise ConfigError(
                f"the instruction '{text}' asks for nothing that is known; the nearest skill is "
                f"'{self.skills[name].phrases[0]}', the nearest motion '{motion.phrasings[0]}'"
            )
        if self._sides[near.argmax()] and not side:
            raise ConfigError(f"the instruction '{text}' does not say with which side; add 'left' or 'right'")
        fitting = np.where(self._sides == side, near, -np.inf)
        if not np.isfinite(fitting.max()):
            raise ConfigError(
                f"the instruction '{text}' says '{side}', but '{name}' has no side to choose: leave it out"
            )
        return str(self._names[fitting.argmax()])

    def clearest(self, name: str) -> str:
        """The phrase of a skill that is least like those of anything else.

        "Kick with the left foot" is nearly "kick high with the left foot"; "strike the ball with the left leg" is not.
        """
        own = self._names == name
        others = np.concatenate([self._codes[~own], self._walking.codes])
        apart = np.linalg.norm(self._codes[own][:, None] - others, axis=-1).min(1)
        return self._texts[int(np.flatnonzero(own)[apart.argmax()])]

    def about_skill(self, text: str) -> bool:
        """Whether a text is about a skill rather than about walking, understood or not. Raises ConfigError for one
        without a word."""
        return bool(self._named(text).any() or (self._alike(text)[0].max() >= SURE and not self._walks(text)))

    def _alike(self, text: str) -> tuple[Array, Array]:
        """Similarity of a text to phrases of skills `(n,)` and of walks."""
        code = self._encoder.encode([text])
        return similarity(code, self._codes)[0], similarity(code, self._walking.codes)[0]

    def _shared(self, text: str) -> Mapping[str, float]:
        """Share, 0 to 1, of a text's telling words that the phrases of each skill, and of each walk, have.

        A word counts the more, the fewer have it (inverse document frequency).
        """
        found = set(words(text)) - _EMPTY
        count = {word: sum(word in known for known in self._known.values()) for word in found}
        weight = {word: np.log(len(self._known) / n) for word, n in count.items() if n}
        whole = sum(weight.values()) or 1.0
        return {name: sum(weight[word] for word in found & known) / whole for name, known in self._known.items()}

    def _walks(self, text: str) -> bool:
        """Whether a text that names no skill is about walking."""
        alike, walking = self._alike(text)
        shared = self._shared(text)
        near = (alike + SHARED * np.array([shared[name] for name in self._names])).max()
        walks = walking + SHARED * np.array([shared[str(motion)] for motion in self._walking.motions])
        return bool(walking.max() >= FAMILIAR and near < walks.max() + MARGIN)

    def _named(self, text: str) -> Array:
        """Which phrases `(n,)` are of skills whose name has a word of the text: what kicks is no way to walk."""
        found = set(words(text)) - _NO_NAME
        return np.array([bool(found & set(name.split("-"))) for name in self._names])

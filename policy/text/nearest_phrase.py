"""Which motion a text asks for, and an error that helps where it asks for none: checked before a robot moves."""

from __future__ import annotations

import re
from collections.abc import Sequence
from functools import cached_property

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.policy.text.captions import MOTIONS, NAMES
from servoid.policy.text.encoder import TextEncoder
from servoid.policy.text.lexicon import flags

# Cosine similarity to some training phrasing below which a text is not about walking, or not English. With the
# "words" encoder, commands lie above it ("start walking": 0.56), other wishes and languages below ("sit down": 0.31).
FAMILIAR = 0.5
_CONFLICTS = (("left", "right"), ("forward", "back"), ("slow", "fast"))
_SIDED = frozenset({"turn", "side-step", "diagonal", "arc"})  # flags of motions that need a side
_SPEEDS = {"slow": "forward slowly", "fast": "forward fast"}  # what walking forward is called by these flags
# Neither the order of words nor a number is in a code: without these checks they would be dropped without a word.
_SEQUENCE = re.compile(
    r"\b(then|after(wards?)?|before(?! (us|me|them|him|her|you)\W*$)|first|until|next)\b|[;.!?]\s*\w"
)
_QUANTITY = re.compile(
    r"\d|\b(once|twice|times|half|quarter|full|(one|two|three|four|five|six|seven|eight|nine|ten)"
    r"( more)? (steps?|turns?|met(er|re)s?|degrees?|seconds?|circles?|rounds?|paces?|feet|foot))\b"
)
_NEGATION = re.compile(r"\b(no|not|never|cannot|(do|does|did|ca|wo|should|must|is|are)n['\u2019]?t)\b")


class Phrasebook:
    """The training phrasings in an encoder's codes."""

    def __init__(self, encoder: TextEncoder) -> None:
        self._encoder = encoder
        pairs = [(index, text) for index, motion in enumerate(MOTIONS) for text in motion.phrasings]
        self.motions = np.array([index for index, _ in pairs])  # (phrasings,)
        self.texts = tuple(text for _, text in pairs)
        self._sides = np.array([side_of(text) for text in self.texts])

    @cached_property
    def codes(self) -> Array:
        """Codes `(phrasings, size)` of `texts`."""
        return self._encoder.encode(self.texts)

    def nearest(self, texts: Sequence[str]) -> Array:
        """Index in `MOTIONS` of the phrasing nearest to each text, `(n,)`. Raises ConfigError as `encode` does."""
        return self.motions[_distances(self._encoder.encode(texts), self.codes).argmin(1)]

    def familiar(self, text: str) -> str:
        """The training phrasing nearest to a text. Raises ConfigError as `encode` does."""
        return self.texts[int(_distances(self._encoder.encode([text]), self.codes)[0].argmin())]

    def understand(self, text: str) -> int:
        """Index in `MOTIONS` of what a text asks for.

        Raises ConfigError for a text that is empty, not in English, not about a known motion, negated, or that asks
        for two opposite motions; for a turn or step to no side; and for what no motion here can be told: one thing
        after another, how far or how long, how fast where a motion has one speed.
        """
        code = self._encoder.encode([text])
        distance = _distances(code, self.codes)[0]
        nearest = int(self.motions[distance.argmin()])
        hint = f"the nearest known motion is '{NAMES[nearest]}': '{MOTIONS[nearest].phrasings[0]}'"
        refuse_untold(text)
        marked = flags(text)
        if similarity(code, self.codes).max() < FAMILIAR:
            raise ConfigError(f"the instruction '{text}' asks for no motion that is known; {hint}")
        side = side_of(text)
        if side == "" and marked & _SIDED:
            raise ConfigError(f"the instruction '{text}' does not say to which side; add 'left' or 'right'")
        # The side is as it was said. Standing has none: "stand on your left foot" stays standing.
        fitting = (self._sides == side) | ((self.motions == NAMES.index("stand")) & ("stop" in marked))
        motion = NAMES[self.motions[np.where(fitting, distance, np.inf).argmin()]]
        for flag in marked & _SPEEDS.keys():
            if not motion.startswith("forward"):
                raise ConfigError(
                    f"the instruction '{text}' says how fast, but '{motion}' has one speed: leave that out; "
                    "walking forward can be slow or fast"
                )
            motion = _SPEEDS[flag]
        return NAMES.index(motion)


def refuse_untold(text: str) -> None:
    """Raise ConfigError for what no instruction can be told: what not to do, one thing after another, how much, or two
    opposite things."""
    if _NEGATION.search(text.lower()):
        raise ConfigError(f"the instruction '{text}' says what not to do; say what to do, such as 'stand still'")
    if _SEQUENCE.search(text.lower()):
        raise ConfigError(f"the instruction '{text}' says one thing after another; give one instruction at a time")
    if _QUANTITY.search(text.lower()):
        raise ConfigError(f"the instruction '{text}' says how much; that is not understood: say only what to do")
    marked = flags(text)
    for one, other in _CONFLICTS:
        if {one, other} <= marked:
            raise ConfigError(f"the instruction '{text}' asks for both {one} and {other}; ask for one at a time")


def side_of(text: str) -> str:
    """The side that a text names, left or right; else nothing."""
    marked = flags(text)
    return next((side for side in ("left", "right") if side in marked), "")


def _distances(codes: Array, others: Array) -> Array:
    """Euclidean distances `(n, m)`."""
    distances: Array = np.linalg.norm(codes[:, None] - others, axis=-1)
    return distances


def similarity(codes: Array, others: Array) -> Array:
    """Cosines `(n, m)`."""
    a, b = (x / np.linalg.norm(x, axis=-1, keepdims=True) for x in (codes, others))
    return a @ b.T

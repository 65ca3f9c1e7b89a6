"""Instructions are understood, or refused with a reason and a remedy, before a robot moves."""

from __future__ import annotations

import pytest

from servoid.hw.config import ConfigError
from servoid.policy.text.captions import MOTIONS, NAMES
from servoid.policy.text.encoder import WordEncoder
from servoid.policy.text.nearest_phrase import Phrasebook


@pytest.fixture(scope="module")
def book() -> Phrasebook:
    return Phrasebook(WordEncoder())


def test_every_phrasing_is_understood(book: Phrasebook) -> None:
    """The evaluation's own instructions must pass the check that a task makes."""
    for index, motion in enumerate(MOTIONS):
        for text in (*motion.phrasings, *motion.held_out):
            assert NAMES[book.understand(text)] == NAMES[index], text


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("Walk!", "forward"),
        ("move", "forward"),
        ("please stop right now", "stand"),
        ("stand on your left foot", "stand"),
        ("rotate counter-clockwise in place", "turn left"),
        ("back up to the right", "backward arc right"),
        ("run", "forward fast"),
        ("gently walk on", "forward slowly"),
        ("slowly go straight on", "forward slowly"),
    ],
)
def test_what_people_say_is_understood(book: Phrasebook, text: str, expected: str) -> None:
    assert NAMES[book.understand(text)] == expected


@pytest.mark.parametrize("text", ["gehe nach links", "marche en avant", "gira a la izquierda", "idź do przodu"])
def test_a_foreign_language_is_refused(book: Phrasebook, text: str) -> None:
    """Its words have vectors too: without the check a robot would do whatever lies nearest."""
    with pytest.raises(ConfigError, match=f"'{text}' asks for no motion that is known; the nearest known motion is"):
        book.understand(text)


@pytest.mark.parametrize("text", ["bake me a cake", "jump", "sit down", "raise your arm", "asdf qwer"])
def test_a_motion_that_is_not_known_is_refused(book: Phrasebook, text: str) -> None:
    with pytest.raises(ConfigError, match=r"the nearest known motion is '.+': '.+'"):
        book.understand(text)


@pytest.mark.parametrize(
    ("text", "reason"),
    [
        ("", "is empty"),
        ("   ", "is empty"),
        ("向左转", "no English word"),
        ("do not walk", "says what not to do"),
        ("don't turn left", "says what not to do"),
        ("turn left, then right", "one thing after another"),
        ("turn left and right", "both left and right"),
        ("walk back and forth", "both forward and back"),
        ("turn", "does not say to which side"),
        ("walk diagonally", "does not say to which side"),
        ("turn right now", "does not say to which side"),
        ("turn left slowly", "says how fast, but 'turn left' has one speed"),
        ("quickly side-step to the right", "says how fast, but 'side-step right' has one speed"),
        ("walk fast, slowly", "both slow and fast"),
        ("walk forward and then turn left", "one thing after another; give one instruction at a time"),
        ("turn left before you walk forward", "one thing after another"),
        ("walk forward. turn left", "one thing after another"),
        ("first walk ahead", "one thing after another"),
        ("walk 2 m forward", "says how much; that is not understood"),
        ("turn left by 90 degrees", "says how much"),
        ("take two steps back", "says how much"),
        ("turn left twice", "says how much"),
    ],
)
def test_an_instruction_that_cannot_be_followed_says_why(book: Phrasebook, text: str, reason: str) -> None:
    with pytest.raises(ConfigError, match=reason):
        book.understand(text)

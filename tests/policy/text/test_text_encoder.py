"""Text codes: what they keep apart, and what loading them does to a program."""

from __future__ import annotations

import logging
import subprocess
import sys

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.policy.text.captions import MOTIONS, mirrored
from servoid.policy.text.encoder import WordEncoder, load_encoder
from servoid.policy.text.lexicon import FLAGS, flags
from servoid.policy.text.nearest_phrase import Phrasebook


@pytest.fixture(scope="module")
def encoder() -> WordEncoder:
    return WordEncoder()


def test_held_out_phrasings_are_nearest_to_their_own_motion(encoder: WordEncoder) -> None:
    """Measured: all 58. Fewer than 0.9 would mean that instructions are guessed."""
    pairs = [(index, text) for index, motion in enumerate(MOTIONS) for text in motion.held_out]
    truth = np.array([index for index, _ in pairs])
    found = Phrasebook(encoder).nearest([text for _, text in pairs])
    wrong = [text for (_, text), right in zip(pairs, found == truth, strict=True) if not right]
    assert np.mean(found == truth) >= 0.95, wrong
    assert not ((found == mirrored(truth)) & (found != truth)).any(), "left taken for right"


def test_flags_are_what_tells_left_from_right(encoder: WordEncoder) -> None:
    """Word vectors alone find their own phrasing's mirror image: without flags most sides would be lost."""
    sided = [motion for index, motion in enumerate(MOTIONS) if mirrored(index) != index]
    codes = encoder.encode([motion.phrasings[0] for motion in sided]).reshape(-1, 2, encoder.size)
    apart = np.linalg.norm(codes[:, 0] - codes[:, 1], axis=-1)
    by_words = np.linalg.norm((codes[:, 0] - codes[:, 1])[:, : encoder.WORD_SIZE], axis=-1)
    assert (apart > 3 * by_words).all()


def test_codes_are_the_same_whatever_is_encoded_beside(encoder: WordEncoder) -> None:
    """A plan from one instruction would differ from the same plan in a batch."""
    texts = ["walk forward", "rotate right on the spot, as quickly as you possibly can", "stop"]
    codes = encoder.encode(texts)
    assert codes.dtype == np.float32
    assert codes.shape == (3, encoder.size) == (3, encoder.WORD_SIZE + len(FLAGS))
    for text, code in zip(texts, codes, strict=True):
        np.testing.assert_array_equal(encoder.encode([text])[0], code)
    np.testing.assert_array_equal(WordEncoder().encode(texts), codes)
    assert encoder.encode([]).shape == (0, encoder.size)


def test_codes_do_not_hang_on_order_case_or_signs(encoder: WordEncoder) -> None:
    codes = encoder.encode(["walk forward and turn left", "Turn LEFT, and walk forward!", "left turn and forward walk"])
    np.testing.assert_array_equal(codes[0], codes[1])
    np.testing.assert_array_equal(codes[0], codes[2])


def test_features_are_of_order_one(encoder: WordEncoder) -> None:
    """A network's first layer would drown in features of ten, or not hear those of a tenth."""
    codes = encoder.encode([text for motion in MOTIONS for text in motion.phrasings])
    assert 0.2 < codes[:, : encoder.WORD_SIZE].std() < 1.0
    assert np.abs(codes).max() <= 3.0


@pytest.mark.parametrize("text", ["", "  ", "?!", "0.3", "向左转", "вперёд"])
def test_a_text_without_an_english_word_is_refused(encoder: WordEncoder, text: str) -> None:
    with pytest.raises(ConfigError, match=r"the instruction .*write one such as 'walk forward'"):
        encoder.encode([text])


@pytest.mark.parametrize(
    ("text", "expected"),
    [
        ("Side-step LEFT, slowly", {"left", "side-step", "slow"}),
        ("rotate counter-clockwise", {"left", "turn"}),
        ("rotate clockwise", {"right", "turn"}),
        ("stop right now", {"stop"}),
        ("walk straight", {"forward"}),
        ("walk straight back", {"back"}),
        ("at full speed", {"fast"}),
        ("at low speed", {"slow"}),
        ("curving rightwards", {"arc", "right"}),
        ("a bright leftover", set()),  # whole words, not parts of them
        ("tournez, links, arrière", set()),
    ],
)
def test_flags_of_a_text(text: str, expected: set[str]) -> None:
    assert flags(text) == expected


def test_an_unknown_encoder_is_named_with_the_nearest() -> None:
    with pytest.raises(ConfigError, match="unknown text encoder 'word'; did you mean 'words'"):
        load_encoder("word")


def test_a_missing_package_comes_with_its_remedy(monkeypatch: pytest.MonkeyPatch) -> None:
    monkeypatch.setitem(sys.modules, "wordllama", None)
    with pytest.raises(ConfigError, match="pip install wordllama"):
        load_encoder()


def test_loading_asks_no_network_and_leaves_logging_alone() -> None:
    """In a process of its own: wordllama sets up the root logger when it is first imported, and it can download."""
    code = """
import logging, socket, sys
from servoid.policy.text.encoder import load_encoder
assert "wordllama" not in sys.modules, "loaded before it is needed"
def refuse(*arguments):
    raise AssertionError("a network connection was asked for")
socket.socket.connect = socket.getaddrinfo = refuse
load_encoder().encode(["walk forward"])
assert "torch" not in sys.modules
print(logging.getLogger().handlers, logging.getLogger().level)
"""
    result = subprocess.run([sys.executable, "-c", code], capture_output=True, text=True, check=True)
    assert result.stdout.strip() == f"[] {logging.WARNING}"

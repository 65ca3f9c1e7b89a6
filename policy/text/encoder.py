"""Text to numbers: what a network that follows instructions is conditioned on."""

from __future__ import annotations

import logging
from collections.abc import Iterator, Sequence
from contextlib import contextmanager
from pathlib import Path
from typing import TYPE_CHECKING, Any, Protocol

import numpy as np

from servoid.hw.config import ConfigError, nearest
from servoid.hw.contracts.body import Array
from servoid.policy.text.lexicon import FLAGS, flags, words

if TYPE_CHECKING:
    from servoid.policy.text.contextual import ContextualEncoder


class TextEncoder(Protocol):
    """Turns texts into codes. The same text gives the same code, whatever is encoded beside it."""

    @property
    def name(self) -> str:
        """What `load_encoder` knows it by; a checkpoint stores it."""
        ...

    @property
    def size(self) -> int:
        """Numbers in a code."""
        ...

    def encode(self, texts: Sequence[str]) -> Array:
        """Codes `(n, size)` float32. Raises ConfigError for a text without a word that it could know."""
        ...

    @property
    def token_size(self) -> int:
        """Numbers in a token."""
        ...

    def tokens(self, texts: Sequence[str], most: int) -> Array:
        """Tokens in their order, `(n, most, token_size)` float32: NaN behind a text's last one, the rest of a longer
        text cut. Raises ConfigError like `encode`."""
        ...


class WordEncoder:
    """The mean of WordLlama's word vectors beside the lexicon's flags, both blind to the order of words.

    A code is `SCALE * [unit sentence vector, FLAG_WEIGHT * flags]`. The weight was chosen on the training phrasings,
    each read by its nearest other one: 0.20 of them right without flags, 0.83 at 0.7, 0.95 at 1. The scale makes
    features of order one, as a network's input should be: the 64 of the sentence have a root mean square of 0.375, a
    flag that is set is 3.
    """

    name = "words"
    WORD_SIZE = 64  # of WordLlama's 256; they are trained to be cut short
    FLAG_WEIGHT = 1.0
    SCALE = 3.0
    size = WORD_SIZE + len(FLAGS)
    token_size = size

    def __init__(self) -> None:
        """Load the weights that the wheel brings. Raises ConfigError where it is missing or incomplete."""
        self._model = _load_wordllama(self.WORD_SIZE)

    def encode(self, texts: Sequence[str]) -> Array:
        return np.stack([self._encode(text) for text in texts]) if texts else np.zeros((0, self.size), np.float32)

    def tokens(self, texts: Sequence[str], most: int) -> Array:
        """Word vectors, each of a mean square of one, with the flags that the word sets; a rare word has several."""
        found = np.full((len(texts), most, self.token_size), np.nan, np.float32)
        for row, text in zip(found, texts, strict=True):
            known_words(text)
            marked, filled = flags(text), 0
            for word in text.lower().split():
                pieces = self._model.tokenizer.encode(word, add_special_tokens=False).ids[: most - filled]
                vectors = self._model.embedding[pieces].astype(np.float32)
                lengths = np.maximum(np.linalg.norm(vectors, axis=-1, keepdims=True), 1e-6)
                at = slice(filled, filled + len(pieces))
                row[at, : self.WORD_SIZE] = np.sqrt(self.WORD_SIZE) * vectors / lengths
                row[at, self.WORD_SIZE :] = [self.SCALE * (flag in flags(word) & marked) for flag in FLAGS]
                filled += len(pieces)
        return found

    def _encode(self, text: str) -> Array:
        found = known_words(text)
        # One text at a time: padding would let the last bits depend on the neighbours.
        sentence = self._model.embed([" ".join(found)])[0]
        norm = max(float(np.linalg.norm(sentence)), 1e-6)
        marked = flags(text)
        flagged = np.array([flag in marked for flag in FLAGS], dtype=np.float32)
        return (self.SCALE * np.concatenate([sentence / norm, self.FLAG_WEIGHT * flagged])).astype(np.float32)


def known_words(text: str) -> list[str]:
    """The words of a text, sorted. Raises ConfigError for one without an English word."""
    found = words(text)
    if not found:
        wrong = f"'{text}' has no English word in it" if text.strip() else "is empty"
        raise ConfigError(f"the instruction {wrong}; write one such as 'walk forward' or 'turn left on the spot'")
    return found


_CONTEXTUAL = "contextual"  # in a module of its own, which is imported when it is asked for
_ENCODERS = (WordEncoder.name, _CONTEXTUAL)


def load_encoder(name: str = WordEncoder.name) -> TextEncoder:
    """The encoder of that name. Raises ConfigError for an unknown one, or when what it needs is not installed."""
    return _encoder(name)()


def code_size(name: str) -> int:
    """Numbers in a code of the encoder of that name, which is not loaded. Raises ConfigError for an unknown one."""
    return _encoder(name).size


def token_size(name: str) -> int:
    """Numbers in a token of the encoder of that name, which is not loaded. Raises ConfigError for an unknown one."""
    return _encoder(name).token_size


def _encoder(name: str) -> type[WordEncoder] | type[ContextualEncoder]:
    if name not in _ENCODERS:
        raise ConfigError(f"unknown text encoder '{name}'; {nearest(name, _ENCODERS)}")
    if name == WordEncoder.name:
        return WordEncoder
    from servoid.policy.text.contextual import ContextualEncoder

    return ContextualEncoder


def _load_wordllama(size: int) -> Any:
    """WordLlama with the weights inside its wheel. Nothing is downloaded."""
    with _root_logger_as_it_is():
        try:
            import wordllama
        except ImportError as error:
            raise ConfigError(
                f"text instructions need the package wordllama, which cannot be imported ({error}); "
                "install it with `pip install wordllama`"
            ) from error
        folder = Path(wordllama.__file__).parent
        try:
            return wordllama.WordLlama.load(cache_dir=folder, trunc_dim=size, disable_download=True)
        except (OSError, ValueError) as error:
            raise ConfigError(
                f"{folder}: wordllama's own weights cannot be loaded ({error}); "
                "install it again with `pip install --force-reinstall wordllama`"
            ) from error


@contextmanager
def _root_logger_as_it_is() -> Iterator[None]:
    """wordllama configures the root logger when it is imported, which would change what a whole program prints."""
    root = logging.getLogger()
    level, handlers = root.level, root.handlers[:]
    try:
        yield
    finally:
        root.setLevel(level)
        root.handlers[:] = handlers

"""Sentences among the settings of tasks, checked before a robot moves."""

from __future__ import annotations

from collections.abc import Mapping

from servoid.hw.config import ConfigError


def require_words(settings: Mapping[str, str], name: str) -> None:
    """Raise ConfigError for the setting `name` without a word, which would otherwise count as none given."""
    if not settings.get(name, "some").strip():
        raise ConfigError(f"--set {name}=: is empty; write one such as 'walk forward'")


def understood(name: str, sentence: str) -> int:
    """Number of the motion that the setting `name` asks for. Raises ConfigError where that is in no known words."""
    from servoid.policy.text.encoder import load_encoder
    from servoid.policy.text.nearest_phrase import Phrasebook

    try:
        return Phrasebook(load_encoder()).understand(sentence)
    except ConfigError as error:
        raise ConfigError(f"--set {name}={sentence}: {error}") from None

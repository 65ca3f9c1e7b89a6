"""Attention masks by name, over state tokens followed by action tokens.

A mask is `(tokens, tokens)` bool, True where the row's token may attend to the column's.
"""

from __future__ import annotations

from collections.abc import Callable
from difflib import get_close_matches

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array


def full(state_ticks: Array, action_ticks: Array) -> Array:
    """Every token attends to every token."""
    tokens = len(state_ticks) + len(action_ticks)
    return np.ones((tokens, tokens), dtype=bool)


def state_full_action_causal(state_ticks: Array, action_ticks: Array) -> Array:
    """The mask of Diffuse-CLoC (arXiv:2503.11801, section 3.1 and figure 3).

    States attend to all states, past and future, and to no action. The action of a tick attends to the states and the
    actions up to that tick: what lies ahead reaches it only through the present state's token, which has seen it.
    """
    states = np.ones((len(state_ticks), len(state_ticks)), dtype=bool)
    no_actions = np.zeros((len(state_ticks), len(action_ticks)), dtype=bool)
    to_states = state_ticks[None, :] <= action_ticks[:, None]
    to_actions = action_ticks[None, :] <= action_ticks[:, None]
    return np.block([[states, no_actions], [to_states, to_actions]])


def causal(state_ticks: Array, action_ticks: Array) -> Array:
    """The mask of UniPhys (section 4.2): a frame sees itself and the frames before it.

    There a token holds an action and the state that it leads to. Here that frame is two tokens, which see each other.
    """
    frames = np.concatenate([state_ticks - 1, action_ticks])
    mask: Array = frames[None, :] <= frames[:, None]
    return mask


def diffuser_local(state_ticks: Array, action_ticks: Array) -> Array:
    """The local attention of Diffuser (arXiv:2205.09991), as Diffuse-CLoC ablates it: a tick sees its neighbours.

    Where not all ticks have tokens, they are the next ones that have.
    """
    ticks = np.concatenate([state_ticks, action_ticks])
    number = np.searchsorted(np.unique(ticks), ticks)
    mask: Array = np.abs(number[None, :] - number[:, None]) <= 1
    return mask


MASKS: dict[str, Callable[[Array, Array], Array]] = {
    "causal": causal,
    "diffuser_local": diffuser_local,
    "full": full,
    "state_full_action_causal": state_full_action_causal,
}


def check_mask(name: str) -> None:
    """Raise ConfigError with the nearest name where no mask is called `name`."""
    if name not in MASKS:
        near = get_close_matches(name, MASKS, n=1, cutoff=0.0)[0]
        raise ConfigError(f"unknown attention mask '{name}': did you mean '{near}'? Known: {', '.join(MASKS)}")


def attention_mask(name: str, state_ticks: Array, action_ticks: Array) -> Array:
    """Mask `name` for tokens of the given ticks. Raises ConfigError where there is none."""
    check_mask(name)
    return MASKS[name](state_ticks, action_ticks)

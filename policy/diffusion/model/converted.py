"""A trained denoiser as one of another shape and other units, to go on with other data."""

from __future__ import annotations

import torch
from torch import Tensor

from servoid.hw.config import ConfigError
from servoid.policy.diffusion.model.checkpoint import Model
from servoid.policy.diffusion.model.config import DenoiserConfig
from servoid.policy.diffusion.model.denoiser import Denoiser, tick_encoding
from servoid.policy.features import Emphasis, Normaliser

_SAME = ("layers", "width", "heads", "history", "levels", "mask", "text", "state_size", "action_size")


def converted(model: Model, config: DenoiserConfig, states: Normaliser, actions: Normaliser) -> dict[str, Tensor]:
    """Weights of a network of `config` for inputs by `states` and `actions` (torch) that predicts what `model` does.

    It does so exactly of clean windows with a token for each tick. Fewer tokens, and noise that is of the new units,
    are to be learned, and so is a clock. Raises ConfigError where the shapes have too little in common.
    """
    old = model.config
    other = [name for name in _SAME if getattr(old, name) != getattr(config, name)]
    if other or config.horizon > old.horizon or (old.ticks and old.ticks != config.ticks) or old.clock > config.clock:
        what = ", ".join(other) or "horizon, ticks or clock"
        raise ConfigError(f"the network to begin with is another one ({what}): give its options, or drop --init")
    if isinstance(model.states, Emphasis) != isinstance(states, Emphasis):
        raise ConfigError("the network to begin with has another --emphasis: give its option, or drop --init")
    known, made = model.denoiser.state_dict(), Denoiser(config).state_dict()
    weights = {name: known[name] if name in known and known[name].shape == w.shape else w for name, w in made.items()}
    _states(weights, known, model.states, states)
    _actions(weights, known, model.actions, actions)
    if config.ticks and not old.ticks:
        _places(weights, known["position"], config)
    if config.clock and not old.clock:
        _text(weights, known)
    return {name: weight.clone() for name, weight in weights.items()}


def _scales(old: Normaliser, new: Normaliser) -> tuple[Tensor, Tensor]:
    """Factor and offset by which what `new` normalises becomes what `old` does."""
    return new.std / old.std, (new.mean - old.mean) / old.std


def _states(weights: dict[str, Tensor], known: dict[str, Tensor], old: Normaliser, new: Normaliser) -> None:
    scale, offset = _scales(old, new)
    one = torch.eye(len(scale))
    old_in, old_out = (old.project, old.recover) if isinstance(old, Emphasis) else (one, one)
    new_in, new_out = (new.project, new.recover) if isinstance(new, Emphasis) else (one, one)
    first, last = known["embed_state.0.weight"], known["head_state.weight"]
    weights["embed_state.0.weight"] = first @ (new_out * scale @ old_in).T
    weights["embed_state.0.bias"] = known["embed_state.0.bias"] + first @ (offset @ old_in)
    back = old_out / scale @ new_in
    weights["head_state.weight"] = back.T @ last
    weights["head_state.bias"] = known["head_state.bias"] @ back - offset / scale @ new_in


def _actions(weights: dict[str, Tensor], known: dict[str, Tensor], old: Normaliser, new: Normaliser) -> None:
    scale, offset = _scales(old, new)
    weights["embed_action.weight"] = known["embed_action.weight"] * scale
    weights["embed_action.bias"] = known["embed_action.bias"] + known["embed_action.weight"] @ offset
    weights["head_action.weight"] = known["head_action.weight"] / scale[:, None]
    weights["head_action.bias"] = (known["head_action.bias"] - offset) / scale


def _places(weights: dict[str, Tensor], position: Tensor, config: DenoiserConfig) -> None:
    """Of learned positions, one a tick, what makes the same of the ticks' waves."""
    ticks = torch.arange(len(position)).numpy() + 1 - config.history
    waves = torch.cat([tick_encoding(ticks, config.width), torch.ones(len(ticks), 1)], 1).double()
    found = (torch.linalg.pinv(waves) @ position.double()).float()
    weights["place.weight"], weights["place.bias"] = found[:-1].T, found[-1]


def _text(weights: dict[str, Tensor], known: dict[str, Tensor]) -> None:
    """More hidden units, which say nothing as yet, and a clock that nothing reads."""
    rows, columns = known["embed_text.0.weight"].shape
    weights["embed_text.0.weight"][:rows] = 0.0
    weights["embed_text.0.weight"][:rows, :columns] = known["embed_text.0.weight"]
    weights["embed_text.0.bias"][:rows] = known["embed_text.0.bias"]
    weights["embed_text.2.weight"][:] = 0.0
    weights["embed_text.2.weight"][:, :rows] = known["embed_text.2.weight"]
    weights["embed_text.2.bias"] = known["embed_text.2.bias"]

"""The shape of a denoiser, and whether the one that a checkpoint describes fits a robot. Free of torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.policy import checkpoint
from servoid.policy.checkpoint import CheckpointError
from servoid.policy.diffusion.features import raw_layout, token_layout
from servoid.policy.diffusion.model.masks import check_mask
from servoid.policy.text.encoder import code_size

KIND = "diffusion"  # of a checkpoint


@dataclass(frozen=True)
class DenoiserConfig:
    """Shape of a denoiser. Stored in the checkpoint."""

    state_size: int
    action_size: int
    layers: int = 2
    width: int = 192
    heads: int = 4
    history: int = 4
    horizon: int = 16
    levels: int = 20
    mask: str = "state_full_action_causal"
    text: str = ""  # name of the encoder of its instructions; empty: it takes none
    text_size: int = 0  # of an encoded instruction
    actions: int = 0  # ticks to come whose actions are planned; 0: all of the horizon

    def __post_init__(self) -> None:
        for name in ("state_size", "action_size", "layers", "width", "heads", "history", "horizon", "levels"):
            if getattr(self, name) < 1:
                raise ConfigError(f"denoiser: {name} must be at least 1, not {getattr(self, name)}")
        check_mask(self.mask)
        if self.text_size < 0 or bool(self.text) != bool(self.text_size):
            raise ConfigError(f"denoiser: an encoder '{self.text}' and a text_size of {self.text_size} do not agree")
        if not 0 <= self.actions <= self.horizon:
            raise ConfigError(
                f"denoiser: actions must be 1 to the horizon of {self.horizon} ticks, or 0 for all, not {self.actions}"
            )
        if self.width % self.heads:
            raise ConfigError(f"denoiser: width {self.width} is not a multiple of heads {self.heads}")

    @property
    def state_ticks(self) -> Array:
        """Ticks of the state tokens, `(history + horizon,)`."""
        return np.arange(1 - self.history, self.horizon + 1)

    @property
    def action_ticks(self) -> Array:
        """Ticks of the action tokens, `(history - 1 + action_horizon,)`."""
        return np.arange(1 - self.history, self.action_horizon)

    @property
    def action_horizon(self) -> int:
        """Ticks to come whose actions are planned."""
        return self.actions or self.horizon

    @property
    def tokens(self) -> int:
        return len(self.state_ticks) + len(self.action_ticks)


def check_fit(path: Path, head: Mapping[str, Any], robot: Robot) -> DenoiserConfig:
    """The network that a header describes. Raises CheckpointError saying why it does not fit `robot`."""
    checkpoint.check(path, head, KIND, robot)
    n = len(robot.joints)
    for name, ours in (("raw", raw_layout(n)), ("token", token_layout(n))):
        checkpoint.check_layout(path, name, head.get(f"{name}_layout", []), ours.to_header())
    try:
        config = DenoiserConfig(**head["config"])
        size = code_size(config.text) if config.text else 0
    except (TypeError, ConfigError) as error:
        raise CheckpointError(f"{path}: the network's config in its header cannot be used: {error}") from error
    if config.text_size != size:
        raise CheckpointError(
            f"{path}: reads instructions as {config.text_size} numbers, and the encoder '{config.text}' gives {size}: "
            f"use the program that trained it, of commit {head['git_commit']}, or train it again"
        )
    return config

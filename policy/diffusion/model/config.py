"""The shape of a denoiser, what it is trained for, and whether the one of a checkpoint fits a robot. Free of torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from functools import cached_property
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.policy import checkpoint
from servoid.policy.checkpoint import CheckpointError
from servoid.policy.diffusion.model.masks import check_mask
from servoid.policy.features import raw_layout, token_layout
from servoid.policy.text.encoder import code_size

KIND = "diffusion"  # of a checkpoint


TOGETHER = 2 / 3  # of the windows that are not for Diffusion Forcing, the share whose tokens go down together


@dataclass(frozen=True, kw_only=True)
class DenoiserShape:
    """What may be chosen of a denoiser's shape, whatever the robot."""

    layers: Annotated[int, "layers of the transformer"] = 2
    width: Annotated[int, "numbers in a token"] = 192
    heads: Annotated[int, "attention heads; the width is a multiple of them"] = 4
    history: Annotated[int, "ticks of past and present states"] = 4
    horizon: Annotated[int, "ticks to come"] = 16
    levels: Annotated[int, "noise levels"] = 20
    mask: Annotated[str, "attention mask (docs/diffusion.md)"] = "state_full_action_causal"
    actions: Annotated[int, "ticks to come that have actions; 0: the whole horizon"] = 0
    ticks: Annotated[tuple[int, ...], "ticks to come that have states, the horizon last; none given: all of them"] = ()
    clock: Annotated[int, "waves that say how long what is told has lasted, as skills need it; 0: nothing does"] = 0

    def __post_init__(self) -> None:
        for name in ("layers", "width", "heads", "history", "horizon", "levels"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        try:
            check_mask(self.mask)
        except ConfigError as error:
            raise ValueError(f"mask: {error}") from error
        if self.clock < 0:
            raise ValueError(f"clock must not be negative, not {self.clock}")
        if not 0 <= self.actions <= self.horizon:
            raise ValueError(
                f"actions must be 1 to the horizon of {self.horizon} ticks, or 0 for all, not {self.actions}"
            )
        if self.ticks and (self.ticks[0] != 1 or (np.diff(self.ticks) < 1).any() or self.ticks[-1] != self.horizon):
            raise ValueError(
                f"ticks must rise from 1 to the horizon of {self.horizon}, not {', '.join(map(str, self.ticks))}"
            )
        if self.width % self.heads:
            raise ValueError(f"width {self.width} is not a multiple of heads {self.heads}")


@dataclass(frozen=True)
class TrainingObjective:
    """What a denoiser is trained for, beside the plain squared error."""

    inference_delay: Annotated[
        int, "longest delay of a plan to train for, in ticks; the actions within it are given"
    ] = 2
    near_actions: Annotated[int, "ticks to come whose actions count in full"] = 8
    far_actions: Annotated[float, "weight of the actions beyond; 0 cuts them, as Diffuse-CLoC does"] = 0.2
    min_snr: Annotated[float, "clip of the signal-to-noise ratio that weights tokens, such as 5; 0: no weights"] = 0.0
    action_rate: Annotated[float, "weight of the error in the change from one action to the next"] = 0.0
    monotone: Annotated[
        float, "share of windows whose noise rises along the window, at most two thirds of what --forcing leaves"
    ] = 0.25
    forcing: Annotated[
        float, "share of windows with independent noise, the past too: Diffusion Forcing (1: with --monotone 0)"
    ] = 0.25

    def __post_init__(self) -> None:
        if self.inference_delay < 0:
            raise ValueError(f"inference_delay must not be negative, not {self.inference_delay}")
        if self.near_actions < 1:
            raise ValueError(f"near_actions must be at least 1 tick, not {self.near_actions}")
        for name in ("far_actions", "min_snr", "action_rate"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, not {getattr(self, name):g}")
        if not 0.0 <= self.forcing <= 1.0:
            raise ValueError(f"forcing must be a share of 0 to 1, not {self.forcing:g}")
        most = TOGETHER * (1.0 - self.forcing)
        if not 0.0 <= self.monotone <= most + 1e-9:
            raise ValueError(
                f"monotone must be a share of 0 to {most:g}, not {self.monotone:g}, with forcing {self.forcing:g}"
            )


@dataclass(frozen=True)
class DenoiserConfig(DenoiserShape):
    """Shape of a denoiser. Stored in the checkpoint. Raises ConfigError for one that cannot be."""

    state_size: int
    action_size: int
    text: str = ""  # name of the encoder of its instructions; empty: it takes none
    text_size: int = 0  # of an encoded instruction, with its clock

    def __post_init__(self) -> None:
        try:
            super().__post_init__()
        except ValueError as error:
            raise ConfigError(f"denoiser: {error}") from error
        if min(self.state_size, self.action_size) < 1:
            raise ConfigError(f"denoiser: sizes must be at least 1, not {self.state_size} and {self.action_size}")
        if self.text_size < 0 or bool(self.text) != bool(self.text_size):
            raise ConfigError(f"denoiser: an encoder '{self.text}' and a text_size of {self.text_size} do not agree")
        if self.clock and not self.text:
            raise ConfigError("denoiser: a clock goes with an encoder of instructions")

    @cached_property
    def state_ticks(self) -> Array:
        """Ticks of the state tokens, `(history + ticks to come,)`."""
        return np.concatenate([np.arange(1 - self.history, 1), self.future_ticks])

    @cached_property
    def future_ticks(self) -> Array:
        """Ticks to come that have state tokens: all up to the horizon, or those that are listed."""
        return np.array(self.ticks) if self.ticks else np.arange(1, self.horizon + 1)

    @cached_property
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
        config = DenoiserConfig(**head["config"] | {"ticks": tuple(head["config"].get("ticks", ()))})
        size = code_size(config.text) + 2 * config.clock if config.text else 0
    except (TypeError, ConfigError) as error:
        raise CheckpointError(f"{path}: the network's config in its header cannot be used: {error}") from error
    if config.text_size != size:
        raise CheckpointError(
            f"{path}: reads instructions as {config.text_size} numbers, but the encoder '{config.text}' gives {size}: "
            f"use the program that trained it, of commit {head['git_commit']}, or train it again"
        )
    return config

"""How a diffusion policy plans: the files in `configs/policies/` that name a checkpoint of the diffusion model."""

from __future__ import annotations

import math
from collections.abc import Mapping
from dataclasses import dataclass, field, replace
from typing import Any

import numpy as np

from servoid.hw.config import ConfigError, load_yaml, nearest, resolve
from servoid.hw.contracts.body import Array
from servoid.policy.diffusion.engines import ENGINES, REFERENCE, check_engine
from servoid.policy.diffusion.model.config import DenoiserConfig
from servoid.policy.diffusion.schedule import (
    PYRAMID,
    TRAPEZOID,
    DenoisingMatrix,
    Rolling,
    autoregressive,
    ddim_levels,
    full_sequence,
    pyramid,
    rolling,
)

SCHEDULES = ("full_sequence", "autoregressive", "pyramid", "rolling")
SHAPES = (PYRAMID, TRAPEZOID)
# Keys, and a value of `schedule`, as they were called, and what they are called now.
RENAMED = {"replan": "execution_horizon", "stabilise": "stabilization_level", "gradual": "pyramid"}


@dataclass(frozen=True)
class GuidanceSettings:
    """Loss guidance: see `servoid.policy.diffusion.guidance.Guidance`. A weight of 0 turns it off."""

    weight: float = 4000.0
    clip: float = 12.0  # longest step over a window; both are in the network's inputs, projected where it has emphasis
    gradient: str = "analytic"
    samples: int = 1  # windows denoised side by side for one plan
    choose: str = "mean"  # of them. mean: they share the mean gradient, the first is run; best: the cheapest is run
    scaled: bool = False  # steps are scaled by what is uncertain at their noise level
    even: bool = False  # each token's gradient has the same norm
    limited: bool = False  # no step is longer than to where the cost would be zero
    repeats: int = 1  # gradient steps a network call, which share weight and clip
    actions: bool = False  # actions move too, by the network's own Jacobian, for a network call more

    def __post_init__(self) -> None:
        if not (math.isfinite(self.weight) and self.weight >= 0 and self.clip > 0):
            raise ValueError(
                f"weight must be a number that is not negative and clip positive, not {self.weight}, {self.clip}"
            )
        for name, count in (("samples", self.samples), ("repeats", self.repeats)):
            if count < 1:
                raise ValueError(f"{name} must be at least 1, not {count}")
        for name, value, known in (
            ("gradient", self.gradient, ("analytic", "network")),
            ("choose", self.choose, ("mean", "best")),
        ):
            if value not in known:
                raise ValueError(f"{name} must be '{known[0]}' or '{known[1]}', not '{value}'")


@dataclass(frozen=True)
class Autoregressive:
    """See `servoid.policy.diffusion.schedule.autoregressive`."""

    block: int = 4  # frames

    def __post_init__(self) -> None:
        if self.block < 1:
            raise ValueError(f"block must be at least 1 frame, not {self.block}")


@dataclass(frozen=True)
class Pyramid:
    """See `servoid.policy.diffusion.schedule.pyramid`."""

    spread: int = 5  # calls by which the last frame is later than the first
    shape: str = PYRAMID

    def __post_init__(self) -> None:
        if self.spread < 0:
            raise ValueError(f"spread must not be negative, not {self.spread}")
        if self.shape not in SHAPES:
            raise ValueError(f"no shape is called '{self.shape}': {nearest(self.shape, SHAPES)}")


@dataclass(frozen=True)
class DiffusionSettings:
    """Settings of the diffusion policy; ticks are those of the control loop."""

    checkpoint: str = "diffusion"  # a shipped one, or the path of a .safetensors file
    steps: int = 2  # network calls that take a token from noise to clean
    lead: int = 1  # extra calls by which the states are finished before the actions
    execution_horizon: int = 2  # ticks between requests: the actions executed of a plan
    delay: int = 1  # ticks from a request to the adoption of its plan
    trim: float = 1.0  # 1/s at which what is asked is corrected by what comes of it; 0: not
    history: int | None = None  # states that a plan is made from; None: as many as the network has
    horizon: int | None = None  # ticks that are planned; None: as many as the network has
    schedule: str = "full_sequence"
    autoregressive: Autoregressive = field(default_factory=Autoregressive)
    pyramid: Pyramid = field(default_factory=Pyramid)
    rolling: Rolling = field(default_factory=Rolling)
    eta: float = 0.0  # 0: DDIM, deterministic; 1: DDPM
    stabilization_level: int = 0  # noise level that clean tokens are shown with
    text_weight: float = 1.0  # classifier-free guidance by the instruction; 0: unread, 1: as trained
    text_nearest: bool = True  # a sentence is read as the nearest one of the training; False: by its own code
    engine: str = REFERENCE  # what runs the network: see `servoid.policy.diffusion.engines`
    guidance: GuidanceSettings = field(default_factory=GuidanceSettings)

    def __post_init__(self) -> None:
        if self.steps < 1 or self.lead < 0 or self.execution_horizon < 1:
            raise ValueError("steps and execution_horizon must be at least 1, and lead must not be negative")
        if not 0 <= self.delay <= self.execution_horizon:
            raise ValueError(f"delay must be 0 to execution_horizon ({self.execution_horizon} ticks), not {self.delay}")
        if self.schedule in RENAMED:
            raise ValueError(f"the schedule '{self.schedule}' is called '{RENAMED[self.schedule]}' now")
        if self.schedule not in SCHEDULES:
            raise ValueError(f"no schedule is called '{self.schedule}': {nearest(self.schedule, SCHEDULES)}")
        if self.engine not in ENGINES:
            raise ValueError(f"no engine is called '{self.engine}': {nearest(self.engine, ENGINES)}")
        through = self.guidance.gradient == "network" and self.guidance.weight > 0
        if through and not ENGINES[self.engine].gradient:
            able = " or ".join(name for name, kind in ENGINES.items() if kind.gradient)
            raise ValueError(
                f"the engine '{self.engine}' has no gradient through the network: set engine: {able}, or "
                "guidance.gradient: analytic"
            )
        if not 0.0 <= self.eta <= 1.0:
            raise ValueError(f"eta must be 0 (DDIM) to 1 (DDPM), not {self.eta}")
        if self.stabilization_level < 0:
            raise ValueError(f"stabilization_level must not be negative, not {self.stabilization_level}")

    def check(self, network: DenoiserConfig, training: Mapping[str, Any] | None = None) -> None:
        """Raise ConfigError where this network cannot serve, or the engine is not installed.

        `training` is how it was trained, by the header of its checkpoint; what that does not say is not asked for.
        """
        check_engine(self.engine)
        for name, ours in (("history", self.history), ("horizon", self.horizon)):
            most = getattr(network, name)
            if ours is not None and not 1 <= ours <= most:
                raise ConfigError(
                    f"diffusion policy: {name} is {ours}, but this checkpoint takes 1 to {most} ticks; "
                    f"lower it, or train a model with --{name} {ours}"
                )
        if self.horizon is not None and self.horizon not in network.future_ticks:
            known = ", ".join(map(str, network.future_ticks))
            raise ConfigError(
                f"diffusion policy: horizon is {self.horizon}, but this checkpoint plans states at ticks {known}: "
                "give one of these"
            )
        training, needed = training or {}, self.execution_horizon + self.delay
        if needed > (horizon := min(self.horizon or network.horizon, network.action_horizon)):
            raise ConfigError(
                f"diffusion policy: a plan must last execution_horizon + delay = {needed} ticks, "
                f"but this one has actions for {horizon}; lower execution_horizon or delay"
            )
        if needed > (near := _near_alone(training, needed)):
            raise ConfigError(
                f"diffusion policy: a plan must last execution_horizon + delay = {needed} ticks, but this checkpoint "
                f"learned only the actions of the next {near}; lower execution_horizon or delay"
            )
        if self.delay > (longest := _longest_delay(training, self.delay)):
            raise ConfigError(
                f"diffusion policy: delay is {self.delay}, but this checkpoint was trained for at most "
                f"{longest} ticks: lower it, or train with --inference-delay {self.delay}"
            )
        if self.stabilization_level > network.levels:
            raise ConfigError(
                f"diffusion policy: stabilization_level must be at most {network.levels}, the network's noise levels"
            )
        try:
            ddim_levels(network.levels, self.steps)
            self.matrix(network)
            self.matrix(network, fresh=1)
        except ValueError as error:
            raise ConfigError(f"diffusion policy: {error}") from error

    def fitted(self, network: DenoiserConfig, training: Mapping[str, Any]) -> DiffusionSettings:
        """The same with fewer steps, less delay and shorter chunks, where this network could not serve otherwise."""
        horizon = min(self.horizon or network.horizon, network.action_horizon)
        actions = _near_alone(training, horizon)
        delay = min(self.delay, _longest_delay(training, self.delay), actions // 2)  # no longer than what is executed
        execution_horizon = min(self.execution_horizon, actions - delay)
        return replace(self, steps=min(self.steps, network.levels), delay=delay, execution_horizon=execution_horizon)

    def matrix(self, network: DenoiserConfig, fresh: int | None = None) -> DenoisingMatrix:
        """The denoising matrix of a plan, with what `history` and `horizon` leave out as pure noise.

        For the rolling schedule `fresh` is the number of frames at the end that no earlier plan had; without an earlier
        plan (None) the window begins as pure noise altogether.
        """
        horizon = self.horizon or network.horizon
        # The frames of a schedule end with the horizon.
        state_frames = np.minimum(network.state_ticks - 1, horizon - 1)
        action_frames = np.minimum(network.action_ticks, horizon - 1)
        frames = state_frames, action_frames
        levels, lead = network.levels, self.lead
        if self.schedule == "autoregressive":
            matrix = autoregressive(levels, self.steps, *frames, self.autoregressive.block, lead)
        elif self.schedule == "pyramid":
            matrix = pyramid(levels, self.steps, *frames, self.pyramid.spread, self.pyramid.shape, lead)
        elif self.schedule == "rolling" and fresh is not None:
            matrix = rolling(levels, self.steps, *frames, self.rolling, fresh, lead)
        else:
            matrix = full_sequence(levels, self.steps, len(state_frames), len(action_frames), lead)
        states, actions = self.used(network)
        return matrix.ignore(~states, ~actions, levels)

    def used(self, network: DenoiserConfig) -> tuple[Array, Array]:
        """State and action tokens that `history` and `horizon` leave in, `(tokens,)` bool each."""
        first, horizon = 1 - (self.history or network.history), self.horizon or network.horizon
        states, actions = network.state_ticks, network.action_ticks
        return (states >= first) & (states <= horizon), (actions >= first) & (actions < horizon)


def _longest_delay(training: Mapping[str, Any], otherwise: int) -> int:
    """The longest delay that was trained for; headers of before it had this name call it `committed`."""
    longest: int = training.get("inference_delay", training.get("committed", otherwise))
    return longest


def _near_alone(training: Mapping[str, Any], ticks: int) -> int:
    """How many of the next `ticks` have actions that were learned: all, unless far ones had no weight in training."""
    return ticks if training.get("far_actions", 1.0) else min(ticks, training["near_actions"])


def with_new_names(settings: Mapping[str, Any]) -> dict[str, Any]:
    """Settings as an older program wrote them into a log, by the names of today."""
    values = {RENAMED.get(key, key): value for key, value in settings.items()}
    return values | {"schedule": RENAMED.get(values["schedule"], values["schedule"])}


def load_settings(name: str = "diffusion") -> DiffusionSettings:
    """Settings by name or file. Raises ConfigError."""
    return load_yaml(resolve("policies", name), DiffusionSettings, RENAMED)

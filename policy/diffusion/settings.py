"""How a diffusion policy plans: `configs/policies/diffusion.yaml`."""

from __future__ import annotations

from dataclasses import dataclass, field

from hw.config import ConfigError, load_yaml, resolve
from policy.diffusion.schedule import ddim_levels


@dataclass(frozen=True)
class GuidanceSettings:
    """Loss guidance: see `policy.diffusion.sampler.Guidance`. A weight of 0 turns it off."""

    weight: float = 4000.0
    clip: float = 12.0
    gradient: str = "analytic"

    def __post_init__(self) -> None:
        if self.weight < 0 or self.clip <= 0:
            raise ValueError(f"weight must not be negative and clip must be positive, not {self.weight}, {self.clip}")
        if self.gradient not in ("analytic", "network"):
            raise ValueError(f"gradient must be 'analytic' or 'network', not '{self.gradient}'")


@dataclass(frozen=True)
class DiffusionSettings:
    """Settings of the diffusion policy; ticks are those of the control loop."""

    checkpoint: str = "diffusion"  # a shipped one, or the path of a .safetensors file
    steps: int = 5  # network calls a plan
    lead: int = 1  # extra calls by which the states are finished before the actions
    replan: int = 4  # ticks between requests
    delay: int = 2  # ticks from a request to the adoption of its plan
    trim: float = 1.0  # 1/s at which what is asked is corrected by what comes of it; 0: not
    text_weight: float = 1.0  # classifier-free guidance by the instruction; 0: unread, 1: as trained
    guidance: GuidanceSettings = field(default_factory=GuidanceSettings)

    def __post_init__(self) -> None:
        if self.steps < 1 or self.lead < 0 or self.replan < 1:
            raise ValueError("steps and replan must be at least 1, and lead must not be negative")
        if not 0 <= self.delay <= self.replan:
            raise ValueError(f"delay must be 0 to replan ({self.replan} ticks), not {self.delay}")

    def check(self, horizon: int, levels: int) -> None:
        """Raise ConfigError where a network of this horizon and number of noise levels cannot serve."""
        if self.replan + self.delay > horizon:
            raise ConfigError(
                f"diffusion policy: a plan must last replan + delay = {self.replan + self.delay} ticks, "
                f"and this checkpoint plans {horizon}; lower replan or delay"
            )
        try:
            ddim_levels(levels, self.steps)
        except ValueError as error:
            raise ConfigError(f"diffusion policy: {error}") from error


def load_settings(name: str = "diffusion") -> DiffusionSettings:
    """Settings by name or file. Raises ConfigError."""
    return load_yaml(resolve("policies", name), DiffusionSettings)

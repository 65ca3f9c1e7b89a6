"""Settings of the expert's training: configs/policies/expert.yaml."""

from __future__ import annotations

from dataclasses import dataclass

from servoid.hw.config import CONFIGS, load_marked, nearest
from servoid.policy.tracker.rewards import TERMS


@dataclass(frozen=True)
class ExpertSettings:
    """Ranges are (low, high); shares are of 1. The file says the rest."""

    hidden: tuple[int, ...]
    noise: tuple[float, float]
    learning_rate: float
    discount: float
    horizon: int
    epochs: int
    mini_batches: int
    mirror: float
    episode_seconds: float
    randomised: float
    hardest_push: float
    push_every: tuple[float, float]
    command_every: tuple[float, float]
    stand: float
    forward: float
    single: float
    backward: float
    rewards: dict[str, float]


def load_settings() -> ExpertSettings:
    """Load the settings. Raises ConfigError, also for a reward that is no term."""
    settings, marks = load_marked(CONFIGS / "policies" / "expert.yaml", ExpertSettings)
    for name in settings.rewards:
        if name not in TERMS:
            raise marks.error(f"rewards.{name}", f"no such reward term; {nearest(name, TERMS)}")
    return settings

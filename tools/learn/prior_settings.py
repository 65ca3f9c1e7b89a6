"""Settings of `servoid train prior` and `servoid train policy`: see `servoid.tools.learn.settings`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, Literal

from servoid.hw.config import nearest
from servoid.tools.learn.settings import DecayedOptimiser, Ppo, Range, StepRun


@dataclass(frozen=True)
class PriorShape:
    """A denoiser of windows."""

    frames: Annotated[int, "frames of a window"] = 10
    stride: Annotated[int, "ticks from one frame to the next: 2 is 25 frames a second at 50 ticks"] = 2
    layers: Annotated[int, "layers of the transformer"] = 2
    width: Annotated[int, "numbers in a token"] = 64
    heads: Annotated[int, "attention heads; the width is a multiple of twice as many"] = 4
    levels: Annotated[int, "noise levels"] = 50

    def __post_init__(self) -> None:
        for name in ("stride", "layers", "width", "heads", "levels"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        if self.levels < 10:
            raise ValueError(f"levels must be at least 10, not {self.levels}: rewards compare at three of them")
        if self.frames < 2:
            raise ValueError(f"frames must be at least 2, not {self.frames}: one shows no motion")
        if self.width % (2 * self.heads):
            raise ValueError(f"width {self.width} is not a multiple of twice heads {self.heads}")


@dataclass(frozen=True)
class PriorTraining(DecayedOptimiser, PriorShape, StepRun):
    """`servoid train prior`."""

    minutes: float = 6.0
    evaluate_every: float = 2.0
    batch: int = 96
    learning_rate: float = 3e-3
    average: Annotated[float, "decay of the averaged weights, which are the ones saved"] = 0.999
    unstyled: Annotated[float, "share of windows that are shown without their style, for guidance"] = 0.1
    standing: Annotated[bool, "learn from windows in which the robot was asked to stand, too"] = False
    moving: Annotated[float, "leave out windows in which no joint comes so far [rad]: a clip has poses that last"] = 0.0
    seconds: Annotated[float, "how much of the data is learned from [s], what is measured on not counted; 0: all"] = 0.0
    mirrored: Annotated[bool, "learn from the data's mirror image, too: not of a clip that has a side"] = True
    licence: Annotated[str, "licence of the data, kept in the checkpoint"] = "Apache-2.0"

    def __post_init__(self) -> None:
        for part in (StepRun, PriorShape, DecayedOptimiser):
            part.__post_init__(self)
        if not 0.0 <= self.unstyled < 1.0:
            raise ValueError(f"unstyled must be a share of 0 to below 1, not {self.unstyled:g}")
        if min(self.seconds, self.moving) < 0.0:
            name = "seconds" if self.seconds < 0.0 else "moving"
            raise ValueError(f"{name} must not be negative, not {getattr(self, name):g}")


@dataclass(frozen=True)
class ScoreSettings:
    """How a prior judges, and where episodes begin."""

    sharpness: Annotated[Range, "w_s of the prior's reward, at the start and at the end, geometric in between"] = (
        0.5,
        1.0,
    )
    scale: Annotated[
        Literal["running", "data"], "what errors are relative to: their running mean, as in SMP, or held-out data's"
    ] = "data"
    random_level: Annotated[bool, "judge at one noise level drawn at random instead of at three"] = False
    generated: Annotated[float, "share of episodes that begin in a state drawn from the prior; others stand"] = 0.7
    starts: Annotated[int, "states that are kept to begin in: generated windows, or bodies that lie"] = 1024
    renewals: Annotated[int, "times in a training that a quarter of them is replaced"] = 16

    def __post_init__(self) -> None:
        if min(self.sharpness) <= 0:
            raise ValueError(f"sharpness must be positive, not {self.sharpness}")
        if not 0.0 <= self.generated <= 1.0:
            raise ValueError(f"generated must be a share of 0 to 1, not {self.generated:g}")
        if self.starts < 1 or self.renewals < 0:
            raise ValueError("starts must be at least 1, and renewals must not be negative")


@dataclass(frozen=True)
class EpisodeSettings(ScoreSettings):
    """Episodes of a task, and their rewards."""

    episode_seconds: Annotated[float, "longest episode [s]"] = 10.0
    randomised: Annotated[float, "share of episodes on a robot drawn at random; the others are nominal"] = 0.5
    unlike: Annotated[
        float, "error of the prior, in multiples of held-out data's, at which an episode ends; 0: it never does so"
    ] = 0.0
    unlike_after: Annotated[float, "time before that can happen [s]: to start from standing takes a while"] = 1.0
    hardest_push: Annotated[float, "hardest push [m/s]; pushes are uniform from zero and grow over the first half"] = (
        0.0
    )
    push_every: Annotated[Range, "time between pushes [s]"] = (0.6, 2.0)
    eased: Annotated[
        Range, "share of episodes of get-up that begin falling or along a clip, at the start and from half of it on"
    ] = (0.7, 0.25)
    lead_rate: Annotated[
        Range, "pace of the clips that lead get-up-by-clips, of their own, at the start and from three fifths of it on"
    ] = (1.4, 2.2)
    decide_every: Annotated[int, "ticks between decisions, without a prior: one with a prior decides at its frames"] = 2
    reach: Annotated[float, "joint target for an action of one [rad], without a prior"] = 0.5
    rewards: Annotated[
        dict[str, float],
        "weights of task, manner, both (their product), change, jerk, effort, shock, blocked, beyond and fall",
    ] = field(default_factory=lambda: {"task": 0.5, "both": 0.5, "change": -0.01, "fall": -5.0})

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.episode_seconds <= 0 or min(self.unlike, self.unlike_after) < 0:
            raise ValueError("episode_seconds must be positive; unlike and unlike_after must not be negative")
        if self.hardest_push < 0 or not 0.0 < self.push_every[0] <= self.push_every[1]:
            raise ValueError("hardest_push must not be negative, and push_every must be positive and rising")
        if min(self.lead_rate) <= 0:
            raise ValueError(f"lead_rate must be positive, not {self.lead_rate}")
        if self.decide_every < 1 or self.reach <= 0:
            raise ValueError("decide_every must be at least 1, and reach must be positive")
        if not 0.0 <= self.randomised <= 1.0:
            raise ValueError(f"randomised must be a share of 0 to 1, not {self.randomised:g}")
        unknown = sorted(set(self.rewards) - set(REWARDED))
        if unknown:
            raise ValueError(f"rewards.{unknown[0]}: no such reward; {nearest(unknown[0], REWARDED)}")
        if not self.rewards:
            raise ValueError("rewards must name one or more")


REWARDED = ("task", "manner", "both", "change", "jerk", "effort", "shock", "blocked", "beyond", "fall")


@dataclass(frozen=True)
class PolicyTraining(EpisodeSettings, Ppo):
    """`servoid train policy`. Samples are decisions: as many a second as the prior has frames."""

    minutes: float = 30.0
    evaluate_every: float = 10.0
    samples: float = 2e6
    worlds: int = 256
    noise: Range = (0.3, 0.1)
    discount: float = 0.98
    critic_alone: Annotated[
        float, "samples for which only the critic learns, where the actor began with demonstrations"
    ] = 100_000

    teacher: Annotated[
        str,
        "policy to imitate wherever this one comes, instead of PPO; for a clip CLIP+CLIP, played round; none: nobody",
    ] = ""
    imitation_steps: Annotated[int, "steps in which a network learns what demonstrations show"] = 6000

    def __post_init__(self) -> None:
        for part in (Ppo, EpisodeSettings):
            part.__post_init__(self)
        if self.critic_alone < 0 or self.imitation_steps < 1:
            raise ValueError("critic_alone must not be negative, and imitation_steps must be at least 1")


PRIOR_TITLES: Mapping[type, str] = {
    PriorShape: "network",
    PriorTraining: "optimiser",
    ScoreSettings: "episodes and rewards",
    EpisodeSettings: "episodes and rewards",
    PolicyTraining: "objective (PPO)",
}

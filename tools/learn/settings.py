"""Settings of every training: one frozen dataclass a method, which makes its flags, their help and its files' check.

The help is grouped by the class that declares a setting first (`TITLES`). `configs/training/` holds a file for each
method, with what differs from the defaults here in the training of the network that ships.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, field
from typing import Annotated, ClassVar, Literal

from servoid.hw.config import nearest
from servoid.policy.diffusion.model.config import DenoiserShape, TrainingObjective
from servoid.policy.latent.actions import LatentConfig
from servoid.policy.tracker.rewards import TERMS

Range = tuple[float, float]


@dataclass(frozen=True)
class TrainingRun:
    """How long, and how often to look."""

    # Fields that may change when a run goes on.
    FREE: ClassVar[frozenset[str]] = frozenset({"minutes", "steps", "samples", "evaluate_every"})

    minutes: Annotated[float, "minutes of training in all, evaluations not counted"] = 45.0
    evaluate_every: Annotated[float, "minutes of training between evaluations; 0: only at the end"] = 5.0
    seed: Annotated[int, "random seed"] = 0

    def __post_init__(self) -> None:
        if self.minutes <= 0:
            raise ValueError(f"minutes must be positive, not {self.minutes:g}")
        for name in ("evaluate_every", "seed"):
            if getattr(self, name) < 0:
                raise ValueError(f"{name} must not be negative, not {getattr(self, name):g}")

    @property
    def budget(self) -> float:
        """Steps to train for, in the trainer's own unit; 0: as many as fit into the minutes."""
        raise NotImplementedError


@dataclass(frozen=True)
class StepRun(TrainingRun):
    """A run that may be measured in steps of the optimiser."""

    steps: Annotated[int, "steps to train for, instead of minutes: as much on any machine; 0: use minutes"] = 0

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.steps < 0:
            raise ValueError(f"steps must not be negative, not {self.steps}")

    @property
    def budget(self) -> float:
        return self.steps


@dataclass(frozen=True)
class DataRun(StepRun):
    """A training on a recorded dataset, judged in closed loop."""

    FREE: ClassVar[frozenset[str]] = TrainingRun.FREE | {"survival_seconds", "survival_worlds", "licence"}

    survival_seconds: Annotated[float, "seconds that the network walks in each evaluation"] = 10.0
    survival_worlds: Annotated[int, "worlds it walks in; 0: judge by the loss on held-out data instead"] = 32
    licence: Annotated[str, "licence of the data, kept in the checkpoint"] = "Apache-2.0"

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.survival_worlds < 0 or self.survival_seconds <= 0:
            raise ValueError("survival_seconds must be positive, and survival_worlds must not be negative")


@dataclass(frozen=True)
class Layers:
    """A multilayer perceptron."""

    hidden: Annotated[tuple[int, ...], "units of each hidden layer"] = (256, 128)

    def __post_init__(self) -> None:
        if not self.hidden or min(self.hidden) < 1:
            raise ValueError(f"hidden must name the units of one layer or more, not {self.hidden}")


@dataclass(frozen=True)
class Optimiser:
    """Of networks that learn from examples."""

    batch: Annotated[int, "windows, pairs of ticks or chunks per step"] = 128
    learning_rate: Annotated[float, "learning rate at its highest"] = 6e-4

    def __post_init__(self) -> None:
        if self.batch < 1 or self.learning_rate <= 0:
            raise ValueError("batch and learning_rate must be positive")


@dataclass(frozen=True)
class DecayedOptimiser(Optimiser):
    """AdamW."""

    weight_decay: Annotated[float, "weight decay of AdamW"] = 1e-3


@dataclass(frozen=True, kw_only=True)
class DiffusionNetwork(DenoiserShape):
    """A denoiser, and what it is shown."""

    text: Annotated[str, "encoder of instructions; empty: a model without instructions"] = "words"
    emphasis: Annotated[float, "emphasis of global states; 0: no projection"] = 5.0


@dataclass(frozen=True)
class DiffusionTraining(DecayedOptimiser, TrainingObjective, DiffusionNetwork, DataRun):
    """`servoid train diffusion`."""

    warmup_steps: Annotated[int, "steps over which the learning rate rises"] = 200
    average: Annotated[float, "decay of the averaged weights, which are the ones saved"] = 0.999
    precision: Annotated[Literal["bf16", "fp32"], "arithmetic of the network"] = "bf16"
    distil_steps: Annotated[int, "network calls of the plans that --distil trains for, beside a lead"] = 2

    def __post_init__(self) -> None:
        for part in (DataRun, DenoiserShape, TrainingObjective, Optimiser):
            part.__post_init__(self)
        if not 1 <= self.distil_steps <= self.levels // 2:
            raise ValueError(f"distil_steps must be 1 to half of the {self.levels} levels, not {self.distil_steps}")
        if self.history < 2:
            raise ValueError(f"history must be at least 2, not {self.history}: what ran last is an action of the past")
        if self.inference_delay > self.horizon:
            raise ValueError(
                f"inference_delay must be 0 to the horizon of {self.horizon} ticks, not {self.inference_delay}"
            )
        if self.warmup_steps < 1:
            raise ValueError(f"warmup_steps must be at least 1, not {self.warmup_steps}")


@dataclass(frozen=True)
class LatentTraining(Optimiser, LatentConfig, DataRun):
    """`servoid train latent`. Loss: squared error of normalised targets + beta KL + weighted change of the latents."""

    minutes: float = 5.0
    evaluate_every: float = 1.0
    batch: int = 512
    learning_rate: float = 1e-3
    beta: Annotated[Range, "weight of the KL divergence, first and last, geometric in between, as in PULSE"] = (
        0.01,
        0.001,
    )
    change: Annotated[float, "weight of the change of latents over a tick, as in PULSE"] = 0.005

    def __post_init__(self) -> None:
        for part in (DataRun, LatentConfig, Optimiser):
            part.__post_init__(self)
        if min(self.beta) <= 0 or self.change < 0:
            raise ValueError("beta must be positive, and change must not be negative")


@dataclass(frozen=True)
class SampleRun(TrainingRun):
    """A run that is measured in ticks of experience."""

    FREE: ClassVar[frozenset[str]] = TrainingRun.FREE | {"worlds"}

    minutes: float = 90.0
    evaluate_every: float = 2.0
    samples: Annotated[float, "ticks of experience to train for, over which learning rate, noise and pushes change"] = (
        20e6
    )
    worlds: Annotated[int, "simulated robots side by side"] = 512

    def __post_init__(self) -> None:
        super().__post_init__()
        if self.samples <= 0 or self.worlds < 1:
            raise ValueError("samples and worlds must be positive")

    @property
    def budget(self) -> float:
        return self.samples


@dataclass(frozen=True)
class Ppo(Layers, SampleRun):
    """PPO, whatever the environment."""

    noise: Annotated[Range, "standard deviation of actions, at the start and at the end; a learned one stayed high"] = (
        0.22,
        0.07,
    )
    learning_rate: Annotated[float, "learning rate at the start; it falls to 15 %"] = 4e-4
    discount: Annotated[float, "discount per tick"] = 0.99
    horizon: Annotated[int, "ticks per world between updates"] = 24
    epochs: Annotated[int, "passes over each batch of samples"] = 3
    mini_batches: Annotated[int, "updates per epoch"] = 6
    mirror: Annotated[float, "weight of the squared difference between an action and that of the mirrored state"] = 1.0
    mirrored: Annotated[bool, "learn from the mirror images of samples, too"] = True
    actor_rate: Annotated[
        float, "share of the learning rate at which the actor learns: less where it begins with what it must not forget"
    ] = 1.0

    def __post_init__(self) -> None:
        SampleRun.__post_init__(self)
        Layers.__post_init__(self)
        for name in ("learning_rate", "horizon", "epochs", "mini_batches", "actor_rate"):
            if getattr(self, name) <= 0:
                raise ValueError(f"{name} must be positive, not {getattr(self, name):g}")
        if min(self.noise) <= 0:
            raise ValueError(f"noise must be positive, not {self.noise}")


@dataclass(frozen=True)
class TrackingSettings:
    """Episodes of the tracking environment and their rewards. Shares are of 1."""

    episode_seconds: Annotated[float, "longest episode [s]"] = 20.0
    randomised: Annotated[float, "share of episodes on a robot drawn at random; the others are nominal"] = 0.8
    hardest_push: Annotated[
        float, "hardest push, of the robot's top speed; pushes are uniform from zero and grow over the first fifth"
    ] = 0.6
    push_every: Annotated[Range, "time between pushes [s]"] = (0.6, 2.0)
    command_every: Annotated[Range, "time between commands [s]"] = (2.0, 5.0)
    stand: Annotated[float, "share of commands that are zero"] = 0.1
    forward: Annotated[float, "share of commands straight ahead, half of them in the upper third of the speeds"] = 0.2
    single: Annotated[float, "share of commands that are only backward, sideways or a turn"] = 0.2
    backward: Annotated[
        float, "share of commands that walk backward while turning and side-stepping, where falls were most frequent"
    ] = 0.25
    turning: Annotated[float, "share of commands that only turn"] = 0.0
    gait: Annotated[str, "gait to learn: a name in configs/policies, or a file; none: the robot's own"] = ""
    faster: Annotated[
        bool, "ask for more than the robot's top speeds, straight ahead and turning on the spot, as that is followed"
    ] = False
    clips: Annotated[tuple[str, ...], "clips of the library to learn; none: all that are of this robot"] = ()
    clip_share: Annotated[float, "share of episodes that begin with a clip, and of walks that lead to one"] = 1.0
    rates: Annotated[Range, "how fast clips are played, of their own speed; the fastest grows over half"] = (0.9, 1.2)
    get_up_rates: Annotated[Range, "the same of clips that begin lying"] = (1.0, 1.6)
    walk_seconds: Annotated[Range, "seconds of walking between two clips"] = (0.6, 2.5)
    planner: Annotated[str, "settings of a closed loop, whose plans are followed: a policy's name, or a file"] = ""
    near: Annotated[float, "with a planner: share of its tasks that begin where there is little left to walk"] = 0.5
    words: Annotated[float, "with a planner: share of episodes that are told sentences of clips, and no place"] = 0.2
    points: Annotated[bool, "see key points alone of what is followed, and add to the pose of standing"] = False
    teacher: Annotated[str, "tracker of any reference to imitate, instead of PPO by reward; none: nobody"] = ""
    walker: Annotated[str, "with a teacher: tracker of the gait to imitate where what is followed walks"] = "expert"
    rewards: Annotated[dict[str, float], "weights of reward terms, per tick (policy/tracker/rewards.py)"] = field(
        default_factory=lambda: {
            "velocity": 3.0,
            "progress": 0.6,
            "yaw_rate": 1.2,
            "pose": 0.4,
            "contact": 0.3,
            "clearance": 0.3,
            "upright": -2.0,
            "height": -20.0,
            "sway_rate": -0.03,
            "slip": -0.5,
            "level_feet": -0.3,
            "impact": -0.1,
            "target_rate": -0.15,
            "target_acceleration": -0.1,
            "effort": -0.005,
            "fall": -10.0,
        }
    )
    clip_rewards: Annotated[dict[str, float], "the same, while a clip is followed"] = field(
        default_factory=lambda: {
            "joints": 1.0,
            "orientation": 2.0,
            "base_height": 1.5,
            "travel": 1.0,
            "slip": -0.3,
            "impact": -0.1,
            "residual": -0.01,
            "residual_rate": -0.3,
            "residual_acceleration": -0.1,
            "effort": -0.005,
            "fall": -10.0,
        }
    )

    def __post_init__(self) -> None:
        for table in ("rewards", "clip_rewards"):
            for name in getattr(self, table):
                if name not in TERMS:
                    raise ValueError(f"{table}.{name}: no such reward term; {nearest(name, TERMS)}")
        for name in ("clip_share", "near", "words"):
            if not 0.0 <= getattr(self, name) <= 1.0:
                raise ValueError(f"{name} must be 0 to 1, not {getattr(self, name):g}")
        if self.points and not self.clip_share:
            raise ValueError("points needs a tracker of any reference: clip_share must not be 0")
        if self.planner and not self.clip_share:
            raise ValueError("planner needs a tracker of any reference: clip_share must not be 0")
        for name in ("rates", "get_up_rates", "walk_seconds"):
            low, high = getattr(self, name)
            if not 0.0 < low <= high:
                raise ValueError(f"{name} must be positive and rising, not {low:g} {high:g}")
        shares = (self.stand, self.forward, self.single, self.backward, self.turning)
        if min(shares) < 0 or sum(shares) > 1.0:
            raise ValueError("stand, forward, single, backward and turning must be shares whose sum is at most 1")


@dataclass(frozen=True)
class TrackerTraining(TrackingSettings, Ppo):
    """`servoid train tracker`."""

    plain_odometry: Annotated[bool, "estimate without the learned correction of odometry"] = False

    def __post_init__(self) -> None:
        for part in (Ppo, TrackingSettings):
            part.__post_init__(self)


@dataclass(frozen=True)
class OdometryWalks:
    """What walks, to learn from and to measure."""

    policy: Annotated[tuple[str, ...], "policies or checkpoints that walk, besides the gait"] = ("expert", "diffusion")
    worlds: Annotated[int, "simulated robots that walk, over all policies"] = 192
    seconds: Annotated[float, "seconds that each of them walks"] = 60.0
    floor: Annotated[float, "friction of the floor that half of them walk on, as a share of the robot's own"] = 1.0
    walks: Annotated[int, "walks of each policy on which the drift is measured"] = 64
    walk_seconds: Annotated[float, "seconds of each of these walks"] = 30.0

    def __post_init__(self) -> None:
        if self.worlds < (kinds := (len(self.policy) + 1) * (1 if self.floor == 1.0 else 2)):
            raise ValueError(f"worlds must be at least the {kinds} kinds of walks, not {self.worlds}")
        if min(self.seconds, self.floor, self.walks, self.walk_seconds) <= 0:
            raise ValueError("seconds, floor, walks and walk_seconds must be positive")


@dataclass(frozen=True)
class OdometryTraining(DecayedOptimiser, Layers, OdometryWalks, StepRun):
    """`servoid train odometry`."""

    minutes: float = 10.0
    evaluate_every: float = 0.0
    steps: int = 3000
    hidden: tuple[int, ...] = (128, 64)
    batch: int = 48
    learning_rate: float = 2e-3
    chunk: Annotated[int, "ticks over which the mean error counts too, because the mean is what drifts"] = 50
    mean_weight: Annotated[float, "weight of the squared mean error"] = 20.0

    def __post_init__(self) -> None:
        for part in (StepRun, OdometryWalks, Layers, Optimiser):
            part.__post_init__(self)
        if self.chunk < 1:
            raise ValueError(f"chunk must be at least 1 tick, not {self.chunk}")


TITLES: Mapping[type, str] = {  # of the help, in its order
    TrainingRun: "run", StepRun: "run", DataRun: "run", SampleRun: "run",
    OdometryWalks: "walks",
    DenoiserShape: "network", DiffusionNetwork: "network", LatentConfig: "network", Layers: "network",
    TrainingObjective: "objective", LatentTraining: "objective", OdometryTraining: "objective", Ppo: "objective (PPO)",
    Optimiser: "optimiser", DecayedOptimiser: "optimiser", DiffusionTraining: "optimiser",
    TrackingSettings: "episodes and rewards", TrackerTraining: "episodes and rewards",
}  # fmt: skip

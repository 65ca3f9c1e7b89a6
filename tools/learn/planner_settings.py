"""Settings of `servoid train planner`: see `servoid.tools.learn.settings`."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from typing import Annotated, Literal

from servoid.policy.diffusion.prefix.config import PlannerShape
from servoid.tools.learn.settings import DecayedOptimiser, Optimiser, StepRun


@dataclass(frozen=True)
class PlannerTakes:
    """What the planner learns from."""

    clips: Annotated[tuple[str, ...], "clips of the library to learn; none: all that are of this robot"] = ()
    clip_takes: Annotated[int, "takes of three clips each"] = 500
    walk_takes: Annotated[int, "walks of the gait"] = 200
    walk_seconds: Annotated[float, "seconds of each of these walks"] = 30.0
    aimed: Annotated[
        str, "motions toward random places (configs/motions), kept where --tracker brings robots there; none: none"
    ] = ""
    aimed_takes: Annotated[int, "takes of these"] = 200
    untold: Annotated[float, "share of windows over which what is asked changes, which are told nothing"] = 0.1
    licence: Annotated[str, "licence of the data beside the clips, kept in the checkpoint"] = "Apache-2.0"

    def __post_init__(self) -> None:
        if min(self.clip_takes, self.walk_takes, self.aimed_takes) < 1 or self.walk_seconds <= 0:
            raise ValueError("clip_takes, walk_takes, aimed_takes and walk_seconds must be positive")
        if not 0.0 <= self.untold <= 1.0:
            raise ValueError(f"untold must be a share of 0 to 1, not {self.untold:g}")


@dataclass(frozen=True)
class PlannerTraining(DecayedOptimiser, PlannerTakes, PlannerShape, StepRun):
    """`servoid train planner`."""

    minutes: float = 60.0
    evaluate_every: float = 10.0
    batch: int = 64
    learning_rate: float = 4e-4
    text: Annotated[str, "encoder of sentences"] = "words"
    target_weight: Annotated[float, "weight of the target loss"] = 1.0
    root: Annotated[float, "by how much deviations of the base's rates and height count more than others'"] = 5.0
    warmup_steps: Annotated[int, "steps over which the learning rate rises"] = 200
    average: Annotated[float, "decay of the averaged weights, which are the ones saved"] = 0.999
    precision: Annotated[Literal["bf16", "fp32"], "arithmetic of the network"] = "bf16"

    def __post_init__(self) -> None:
        for part in (StepRun, PlannerShape, PlannerTakes, Optimiser):
            part.__post_init__(self)
        if self.target_weight < 0 or self.root <= 0 or self.warmup_steps < 1:
            raise ValueError("target_weight must not be negative, root positive, and warmup_steps at least 1")


PLANNER_TITLES: Mapping[type, str] = {PlannerTakes: "takes", PlannerShape: "network", PlannerTraining: "optimiser"}

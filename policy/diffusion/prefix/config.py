"""The shape of a planner, and whether the one of a checkpoint fits a robot. Free of torch."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

from servoid.hw.config import ConfigError
from servoid.hw.robot.description import Robot
from servoid.policy import checkpoint
from servoid.policy.checkpoint import CheckpointError
from servoid.policy.diffusion.prefix.frames import Frames
from servoid.policy.text.encoder import token_size

KIND = "planner"  # of a checkpoint


@dataclass(frozen=True, kw_only=True)
class PlannerShape:
    """What may be chosen of a planner's shape, whatever the robot. Frames are 25 a second."""

    layers: Annotated[int, "layers of the transformer"] = 3
    width: Annotated[int, "numbers in a token"] = 128
    heads: Annotated[int, "attention heads; the width is a multiple of them"] = 4
    prefix: Annotated[int, "frames of the motion so far"] = 20
    frames: Annotated[int, "frames of a plan"] = 40
    levels: Annotated[int, "noise levels, and denoising steps"] = 10
    words: Annotated[int, "tokens of a sentence that are read; what is longer is cut"] = 16

    def __post_init__(self) -> None:
        for name in ("layers", "width", "heads", "prefix", "frames", "levels", "words"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")
        if self.width % self.heads:
            raise ValueError(f"width {self.width} is not a multiple of heads {self.heads}")


@dataclass(frozen=True, kw_only=True)
class PlannerConfig(PlannerShape):
    """Shape of a planner of one robot. Stored in the checkpoint. Raises ConfigError for one that cannot be."""

    size: int  # numbers in a frame
    target_size: int  # in an encoded target
    text: str  # name of the encoder of sentences
    text_size: int  # numbers in one of its tokens

    def __post_init__(self) -> None:
        try:
            super().__post_init__()
        except ValueError as error:
            raise ConfigError(f"planner: {error}") from error
        if min(self.size, self.target_size, self.text_size) < 1:
            raise ConfigError("planner: sizes must be at least 1")


def check_fit(path: Path, head: Mapping[str, Any], robot: Robot, frames: Frames) -> PlannerConfig:
    """The planner that a header describes. Raises CheckpointError saying why it does not fit `robot`."""
    checkpoint.check(path, head, KIND, robot)
    checkpoint.check_layout(path, "frame", head.get("frame_layout", []), frames.layout.to_header())
    if (points := head.get("key_points")) != list(frames.key_points.names):
        raise CheckpointError(f"{path}: its key points are {points}, those of {robot.name} {frames.key_points.names}")
    try:
        config = PlannerConfig(**head["config"])
        size = token_size(config.text)
    except (TypeError, ConfigError) as error:
        raise CheckpointError(f"{path}: the planner's config in its header cannot be used: {error}") from error
    if config.text_size != size:
        raise CheckpointError(f"{path}: reads words as {config.text_size} numbers, but '{config.text}' gives {size}")
    return config

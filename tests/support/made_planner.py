"""A planner of 6 frames whose plans hardly leave standing: its weights are random and its deviations small."""

from __future__ import annotations

from pathlib import Path

import numpy as np
import torch

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.policy.checkpoint import Origin
from servoid.policy.diffusion.prefix import target
from servoid.policy.diffusion.prefix.config import PlannerConfig
from servoid.policy.diffusion.prefix.frames import Frames
from servoid.policy.diffusion.prefix.model import PlannerModel, save
from servoid.policy.diffusion.prefix.network import PlannerNetwork
from servoid.policy.features import Normaliser
from servoid.policy.text.encoder import load_encoder


def _standing(robot: Robot, frames: Frames) -> Array:
    """A frame of standing at home `(size,)`."""
    place = np.tile([0.0, 0.0, robot.standing_height], (2, 1))
    motion = frames.motion(place, np.tile([1.0, 0.0, 0.0, 0.0], (2, 1)), np.tile(robot.home, (2, 1)))
    frame: Array = frames.to_relative(motion)[0]
    return frame


def write_planner(path: Path, robot: Robot) -> str:
    """Write one, that knows some sentences; returns its path."""
    torch.manual_seed(0)
    frames, encoder = Frames(robot), load_encoder("words")
    size = frames.layout.size
    config = PlannerConfig(
        layers=1, width=32, prefix=4, frames=6, levels=5, words=6,
        size=size, target_size=target.size(frames), text="words", text_size=encoder.token_size,
    )  # fmt: skip
    around = Normaliser(_standing(robot, frames).astype(np.float32), np.full(size, 0.01, np.float32)).to_torch()
    model = PlannerModel(PlannerNetwork(config), around, ("wave", "kick", "walk forward", "stand still"))
    weights = dict(model.network.named_parameters())
    save(path, weights, model, frames, Origin("nothing", "Apache-2.0", {}, {}))
    return str(path)

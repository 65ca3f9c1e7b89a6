"""Checkpoints of planners: a network with the normalisation of its frames."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path

import torch
from torch import Tensor

from servoid.hw.robot.description import Robot
from servoid.policy import checkpoint
from servoid.policy.checkpoint import CheckpointError, Origin
from servoid.policy.diffusion.prefix.config import KIND, PlannerConfig, check_fit
from servoid.policy.diffusion.prefix.frames import Frames
from servoid.policy.diffusion.prefix.network import PlannerNetwork
from servoid.policy.features import Normaliser


@dataclass(frozen=True)
class PlannerModel:
    """A planner of one robot; its normaliser holds torch tensors."""

    network: PlannerNetwork
    normaliser: Normaliser
    sentences: tuple[str, ...]  # that it was trained with

    @property
    def config(self) -> PlannerConfig:
        return self.network.config


def save(path: Path, weights: Mapping[str, Tensor], model: PlannerModel, frames: Frames, origin: Origin) -> None:
    """Write a planner with other `weights`, averaged ones for instance. Raises CheckpointError."""
    head = checkpoint.header(
        KIND,
        frames.robot,
        config=asdict(model.config),
        data=origin.data,
        licence=origin.licence,
        results=origin.results,
        frame_layout=frames.layout.to_header(),
        key_points=list(frames.key_points.names),
        sentences=list(model.sentences),
        training=dict(origin.training),
    )
    tensors = {f"network.{name}": value.detach().float().numpy() for name, value in weights.items()}
    arrays = {f"frames.{name}": value for name, value in model.normaliser.to_numpy().items()}
    checkpoint.write(path, tensors | arrays, head)


def load(path: Path, robot: Robot, frames: Frames) -> PlannerModel:
    """Read a planner. Raises CheckpointError where it is none, or does not fit the robot."""
    head, arrays = checkpoint.read(path)
    config = check_fit(path, head, robot, frames)
    network = PlannerNetwork(config).eval().requires_grad_(False)
    try:
        weights = {name: torch.from_numpy(array) for name, array in checkpoint.part(arrays, "network").items()}
        missing, unknown = network.load_state_dict(weights, strict=False)
        if unknown or set(missing) - {name for name, _ in network.named_buffers()}:
            raise KeyError(", ".join([*missing, *unknown]))
        normaliser = Normaliser.from_numpy(checkpoint.part(arrays, "frames")).to_torch()
        sentences = tuple(str(text) for text in head["sentences"])
    except (KeyError, TypeError, RuntimeError) as error:
        raise CheckpointError(f"{path}: its tensors are not those of its config: {error}") from error
    return PlannerModel(network, normaliser, sentences)

"""Checkpoints of the diffusion core: a denoiser with the normalisation of its features."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass, field
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.policy import checkpoint
from servoid.policy.checkpoint import CheckpointError, Origin
from servoid.policy.diffusion.model.action_space import JOINT_TARGETS, PREFIX, ActionSpace, latents_in
from servoid.policy.diffusion.model.config import KIND, DenoiserConfig, check_fit
from servoid.policy.diffusion.model.denoiser import Denoiser
from servoid.policy.features import Normaliser, raw_layout, token_layout
from servoid.policy.latent.actions import LatentActions


@dataclass(frozen=True)
class Model:
    """A denoiser with what turns features into its inputs. Normalisers hold torch tensors."""

    denoiser: Denoiser
    states: Normaliser
    actions: Normaliser
    header: Mapping[str, Any]
    space: ActionSpace = JOINT_TARGETS  # what the actions are that `actions` normalises

    @property
    def config(self) -> DenoiserConfig:
        return self.denoiser.config

    @property
    def latents(self) -> LatentActions | None:
        """What its actions are, where they are no joint targets."""
        return self.space if isinstance(self.space, LatentActions) else None


@dataclass(frozen=True)
class Trained:
    """What training made: a denoiser's weights (a state_dict), what turns features into its inputs, and what its
    actions are where they are no joint targets."""

    weights: Mapping[str, Tensor]
    config: DenoiserConfig
    states: Normaliser
    actions: Normaliser
    latents: LatentActions | None = None
    skills: Mapping[str, tuple[str, ...]] = field(default_factory=dict)  # that it knows, with their phrasings


def save(path: Path, trained: Trained, robot: Robot, origin: Origin) -> None:
    """Write all that is needed to run a trained network. Raises CheckpointError."""
    n, latents = len(robot.joints), trained.latents
    head = checkpoint.header(
        KIND,
        robot,
        config=asdict(trained.config),
        **vars(origin),
        raw_layout=raw_layout(n).to_header(),
        token_layout=token_layout(n).to_header(),
    )
    if trained.skills:
        head["skills"] = {name: list(phrasings) for name, phrasings in trained.skills.items()}
    tensors: dict[str, Array] = {f"denoiser.{k}": v.detach().float().cpu().numpy() for k, v in trained.weights.items()}
    for name, normaliser in (("states", trained.states), ("actions", trained.actions)):
        tensors |= {f"{name}.{key}": value for key, value in normaliser.to_numpy().items()}
    if latents is not None:
        head[PREFIX] = latents.describe(n)
        tensors |= {f"{PREFIX}.{key}": value for key, value in latents.to_tensors().items()}
    checkpoint.write(path, tensors, head)


def load(path: Path, robot: Robot) -> Model:
    """Load a denoiser for `robot`, in evaluation mode. Raises CheckpointError saying what does not fit."""
    head, tensors = checkpoint.read(path)
    denoiser = Denoiser(check_fit(path, head, robot))
    try:
        denoiser.load_state_dict({k: torch.from_numpy(v) for k, v in checkpoint.part(tensors, "denoiser").items()})
        states, actions = (
            Normaliser.from_numpy(checkpoint.part(tensors, name)).to_torch() for name in ("states", "actions")
        )
    except (KeyError, TypeError, RuntimeError) as error:
        raise CheckpointError(f"{path}: its tensors do not fit its own header: {error}") from error
    denoiser.eval().requires_grad_(False)
    return Model(denoiser, states, actions, head, latents_in(path, head, tensors, robot) or JOINT_TARGETS)

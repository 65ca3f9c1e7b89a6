"""Checkpoints of the diffusion core: a denoiser with the normalisation of its features."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import asdict, dataclass
from pathlib import Path
from typing import Any

import torch
from torch import Tensor

from hw.hal import Array
from hw.robot import Robot
from policy import checkpoint
from policy.checkpoint import CheckpointError
from policy.diffusion.config import KIND, DenoiserConfig, check_fit
from policy.diffusion.denoiser import Denoiser
from policy.diffusion.features import Normaliser, raw_layout, token_layout


@dataclass(frozen=True)
class Model:
    """A denoiser with what turns features into its inputs. Normalisers hold torch tensors."""

    denoiser: Denoiser
    states: Normaliser
    actions: Normaliser
    header: Mapping[str, Any]

    @property
    def config(self) -> DenoiserConfig:
        return self.denoiser.config


def save(
    path: Path,
    weights: Mapping[str, Tensor],
    config: DenoiserConfig,
    states: Normaliser,
    actions: Normaliser,
    robot: Robot,
    *,
    data: str,
    licence: str,
    results: Mapping[str, Any],
    training: Mapping[str, Any],
) -> None:
    """Write `weights` (a denoiser's state_dict) and all that is needed to run them. Raises CheckpointError."""
    n = len(robot.joints)
    head = checkpoint.header(
        KIND,
        robot,
        config=asdict(config),
        data=data,
        licence=licence,
        results=results,
        training=dict(training),
        raw_layout=raw_layout(n).to_header(),
        token_layout=token_layout(n).to_header(),
    )
    tensors: dict[str, Array] = {f"denoiser.{k}": v.detach().float().cpu().numpy() for k, v in weights.items()}
    for name, normaliser in (("states", states), ("actions", actions)):
        tensors |= {f"{name}.{key}": value for key, value in normaliser.to_numpy().items()}
    checkpoint.write(path, tensors, head)


def load(path: Path, robot: Robot) -> Model:
    """Load a denoiser for `robot`, in evaluation mode. Raises CheckpointError saying what does not fit."""
    head, tensors = checkpoint.read(path)
    denoiser = Denoiser(check_fit(path, head, robot))
    try:
        denoiser.load_state_dict({k: torch.from_numpy(v) for k, v in _part(tensors, "denoiser").items()})
        states, actions = (Normaliser.from_numpy(_part(tensors, name)).to_torch() for name in ("states", "actions"))
    except (KeyError, TypeError, RuntimeError) as error:
        raise CheckpointError(f"{path}: its tensors do not fit its own header: {error}") from error
    denoiser.eval().requires_grad_(False)
    return Model(denoiser, states, actions, head)


def _part(tensors: Mapping[str, Array], name: str) -> dict[str, Array]:
    """The tensors `name.*`, without the prefix."""
    return {k.removeprefix(f"{name}."): v for k, v in tensors.items() if k.startswith(f"{name}.")}

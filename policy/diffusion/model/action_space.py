"""What a denoiser calls an action: joint targets, or latents that are decoded with the state of their tick."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any, Protocol

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.policy import checkpoint
from servoid.policy.checkpoint import CheckpointError
from servoid.policy.latent.actions import LatentActions

PREFIX = "latent"  # of the tensors of latent actions in a diffusion checkpoint, and the key of its header


class ActionSpace(Protocol):
    """Joint targets [rad] <-> actions of a plan. Rows are raw ones (`servoid.policy.features.raw_layout`)."""

    def encode(self, rows: Array, targets: Array, /) -> Array:
        """Actions `(..., action size)` that joint targets `(..., n_joints)` are in states `(..., raw size)`."""
        ...

    def decode(self, rows: Array, actions: Array, /) -> Array:
        """Joint targets `(..., n_joints)` that actions `(..., action size)` are in states `(..., raw size)`."""
        ...


class JointTargets:
    """Actions are the joint targets themselves."""

    def encode(self, rows: Array, targets: Array) -> Array:
        return targets

    def decode(self, rows: Array, actions: Array) -> Array:
        return actions


JOINT_TARGETS = JointTargets()


def latents_in(path: Path, head: Mapping[str, Any], tensors: Mapping[str, Array], robot: Robot) -> LatentActions | None:
    """The latent actions that a diffusion checkpoint holds; None: it plans joint targets. Raises CheckpointError."""
    n, planned = len(robot.joints), head["config"]["action_size"]
    if PREFIX not in head:
        if planned != n:
            raise CheckpointError(f"{path}: plans {planned} numbers a tick, but {robot.name} has {n} joints")
        return None
    made = LatentActions.from_tensors(path, head[PREFIX], checkpoint.part(tensors, PREFIX), n)
    if made.size != planned:
        raise CheckpointError(f"{path}: plans {planned} numbers a tick, but its latents have {made.size}")
    return made


def load_action_space(path: Path, robot: Robot) -> ActionSpace:
    """What the actions of a diffusion checkpoint mean. Raises CheckpointError."""
    return latents_in(path, *checkpoint.read(path), robot) or JOINT_TARGETS

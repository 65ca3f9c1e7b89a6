"""Latent actions at run time: joint targets <-> latents, each given the state of its own tick. Free of torch.

UniPhys (section 3) plans in the latent space of PULSE (Luo et al., arXiv:2310.04582): an encoder E(z | s, a), a learned
prior P(z | s) and a decoder a = D(s, z). What the body does anyway in a state is in the decoder and the prior; a latent
says what is decided beyond that. PULSE's encoder sees the motion to track, this one the action that was decided.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import Annotated, Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.policy import checkpoint
from servoid.policy.checkpoint import CheckpointError
from servoid.policy.features import AnyArray, Layout, raw_layout
from servoid.policy.mlp import Mlp

KIND = "latent"  # of a checkpoint
LAYOUT = "state_layout"  # key of a header: the fields of what latents are conditioned on
_PARTS = ("encoder", "prior", "decoder")
_HEIGHT = 2  # index of z among the displacement's x, y, z, which come first in a row, with yaw after them


def proprioception_layout(n_joints: int) -> Layout:
    """The fields of `proprioception`, SI units, frames as in `servoid.policy.features.raw_layout`."""
    of_row = dict(raw_layout(n_joints).fields)
    kept = ("velocity", "angular_velocity", "gravity", "position", "joint_velocity")
    return Layout((("height", 1), *((name, of_row[name]) for name in kept)))


def proprioception(raw: AnyArray) -> AnyArray:
    """Raw rows `(..., raw size)` without the place: `(..., raw size - 3)`, a numpy array or a torch tensor."""
    index = [_HEIGHT, *range(_HEIGHT + 2, raw.shape[-1])]
    return raw[..., index]


@dataclass(frozen=True)
class LatentConfig:
    """Shape of the three networks. Stored in the checkpoint."""

    size: Annotated[int, "numbers in a latent; PULSE has 32 for a human's 69 joints"] = 16
    width: Annotated[int, "units of each hidden layer"] = 256
    layers: Annotated[int, "hidden layers"] = 2

    def __post_init__(self) -> None:
        for name in ("size", "width", "layers"):
            if getattr(self, name) < 1:
                raise ValueError(f"{name} must be at least 1, not {getattr(self, name)}")


@dataclass(frozen=True)
class LatentActions:
    """Encoder and prior give means and log variances side by side, `(..., 2 size)`; the decoder joint targets [rad]."""

    encoder: Mlp
    prior: Mlp
    decoder: Mlp

    @property
    def size(self) -> int:
        """Numbers of a latent."""
        return self.prior.sizes[-1] // 2

    def encode(self, rows: Array, targets: Array) -> Array:
        """Posterior means `(..., size)` of joint targets `(..., n_joints)` rad, given raw rows `(..., raw size)`."""
        return self.encoder(np.concatenate([proprioception(rows), targets], -1))[..., : self.size]

    def decode(self, rows: Array, latents: Array) -> Array:
        """Joint targets `(..., n_joints)` rad of latents `(..., size)`, given raw rows `(..., raw size)`."""
        return self.decoder(np.concatenate([proprioception(rows), latents], -1))

    def expected(self, rows: Array) -> Array:
        """Means of the prior `(..., size)`: what is decided most often in states `(..., raw size)`."""
        return self.prior(proprioception(rows))[..., : self.size]

    def to_tensors(self) -> dict[str, Array]:
        """Its arrays by name, as a checkpoint stores them."""
        return {f"{name}.{key}": value for name in _PARTS for key, value in getattr(self, name).to_tensors().items()}

    def describe(self, n_joints: int) -> dict[str, Any]:
        """What a header says of them: config and the layout of the state."""
        hidden = self.prior.sizes[1:-1]
        config = {"size": self.size, "width": hidden[0], "layers": len(hidden)}
        return {"config": config, LAYOUT: proprioception_layout(n_joints).to_header()}

    @classmethod
    def from_tensors(
        cls, path: Path, description: Mapping[str, Any], tensors: Mapping[str, Array], n_joints: int
    ) -> LatentActions:
        """Inverse of `to_tensors` and `describe`. Raises CheckpointError naming `path` where they do not fit."""
        state = proprioception_layout(n_joints)
        checkpoint.check_layout(path, "latent actions' state", description.get(LAYOUT, []), state.to_header())
        try:
            config = LatentConfig(**description["config"])
            made = cls(*(Mlp.from_tensors(checkpoint.part(tensors, name)) for name in _PARTS))
            hidden, n, z = (config.width,) * config.layers, state.size, config.size
            found = [part.sizes for part in (made.encoder, made.prior, made.decoder)]
        except (KeyError, TypeError, IndexError, ValueError) as error:
            raise CheckpointError(f"{path}: its latent actions do not fit its own header: {error}") from error
        needed = [(n + n_joints, *hidden, 2 * z), (n, *hidden, 2 * z), (n + z, *hidden, n_joints)]
        if found != needed:
            raise CheckpointError(
                f"{path}: its latent actions do not fit its own header: {found}, but {needed} are needed"
            )
        return made


def same_latents(a: LatentActions | None, b: LatentActions | None) -> bool:
    """Whether both mean the same by an action; None: joint targets."""
    if a is None or b is None:
        return a is b
    ours, theirs = a.to_tensors(), b.to_tensors()
    return ours.keys() == theirs.keys() and all(np.array_equal(ours[name], theirs[name]) for name in ours)


def save_latents(path: Path, latents: LatentActions, robot: Robot, origin: checkpoint.Origin) -> None:
    """Write a checkpoint of the kind `latent`. Raises CheckpointError."""
    head = checkpoint.header(KIND, robot, **vars(origin), **latents.describe(len(robot.joints)))
    checkpoint.write(path, latents.to_tensors(), head)


def load_latents(path: Path, robot: Robot) -> LatentActions:
    """Read a checkpoint of the kind `latent` for `robot`. Raises CheckpointError saying what does not fit."""
    head, tensors = checkpoint.read(path)
    checkpoint.check(path, head, KIND, robot)
    return LatentActions.from_tensors(path, head, tensors, len(robot.joints))

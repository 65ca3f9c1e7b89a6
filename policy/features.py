"""State and actions <-> tokens.

A raw row is what a recording holds of one tick, in the odometry frame. A token row describes the same tick seen from
the canonical frame: the heading frame of the present tick, with its origin under the present base. So a window looks
the same wherever the robot stands. Both keep the same information, and `to_raw` undoes `to_tokens`.

Every function takes numpy arrays or torch tensors and returns what it was given; torch is not imported here.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass, fields, replace
from functools import cache, cached_property
from typing import Any, Self

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import State
from servoid.hw.robot.description import Robot
from servoid.hw.robot.mirror import Mirror

AnyArray = Any  # a numpy array or a torch tensor


@dataclass(frozen=True)
class Layout:
    """Named fields of a row, in order."""

    fields: tuple[tuple[str, int], ...]

    @property
    def size(self) -> int:
        return sum(size for _, size in self.fields)

    @cached_property
    def slices(self) -> Mapping[str, slice]:
        """Where each field lies in a row."""
        ends = np.cumsum([size for _, size in self.fields]).tolist()
        return {name: slice(end - size, end) for (name, size), end in zip(self.fields, ends, strict=True)}

    def slice(self, name: str) -> slice:
        """Where a field lies in a row. Raises KeyError."""
        if name not in self.slices:
            raise KeyError(f"no field '{name}' in this layout: {', '.join(field for field, _ in self.fields)}")
        return self.slices[name]

    def split(self, rows: AnyArray) -> dict[str, AnyArray]:
        """Fields of `(..., size)` rows by name."""
        return {name: rows[..., at] for name, at in self.slices.items()}

    def to_header(self) -> list[list[Any]]:
        """The layout as a checkpoint stores it."""
        return [[name, size] for name, size in self.fields]


@cache
def raw_layout(n_joints: int) -> Layout:
    """A tick as it is recorded: odometry frame, SI units (see `servoid.hw.contracts.control.State`)."""
    return Layout(
        (
            ("displacement", 3),  # m, z above the ground
            ("yaw", 1),  # rad
            ("velocity", 3),  # m/s, heading frame of its own tick
            ("angular_velocity", 3),  # rad/s, base frame
            ("gravity", 3),  # unit vector, base frame
            ("position", n_joints),  # rad
            ("joint_velocity", n_joints),  # rad/s
        )
    )


def recorded_names(robot: Robot) -> dict[str, tuple[str, ...]]:
    """Columns of a recording by name, and the names of their numbers: those of `raw_layout`, joints, or a command."""
    axes = {"displacement": "xyz", "yaw": ("",), "velocity": "xyz", "angular_velocity": "xyz", "gravity": "xyz"}
    fields = (field for field, _ in raw_layout(len(robot.joints)).fields)
    state = tuple(f"{field}.{part}".rstrip(".") for field in fields for part in axes.get(field, robot.names))
    joints = tuple(robot.names)
    command = ("forward", "left", "turn")
    return {"observation.state": state, "action": joints, "action_applied": joints, "command": command}


@cache
def token_layout(n_joints: int) -> Layout:
    """A tick as the network sees it: canonical frame, SI units, before normalisation."""
    return Layout(
        (
            ("displacement", 2),  # m from the present base
            ("heading", 2),  # cosine and sine of the yaw from the present one
            ("height", 1),  # m
            ("velocity", 3),  # m/s, heading frame of its own tick
            ("angular_velocity", 3),  # rad/s, base frame
            ("gravity", 3),  # unit vector, base frame
            ("position", n_joints),  # rad
            ("joint_velocity", n_joints),  # rad/s
        )
    )


def raw_row(state: State) -> Array:
    """Raw rows `(..., size)` float32 of a State."""
    parts = (
        state.displacement,
        np.asarray(state.yaw)[..., None],
        state.velocity,
        state.angular_velocity,
        state.gravity,
        state.position,
        state.joint_velocity,
    )
    return np.concatenate(parts, -1).astype(np.float32)


def _namespace(x: AnyArray) -> Any:
    if isinstance(x, np.ndarray):
        return np
    import torch

    return torch


def _rotate(xy: AnyArray, yaw: AnyArray, xp: Any) -> AnyArray:
    """Turn planar vectors `(..., 2)` by `yaw` `(...)`."""
    c, s = xp.cos(yaw), xp.sin(yaw)
    x, y = xy[..., 0], xy[..., 1]
    return xp.stack([c * x - s * y, s * x + c * y], -1)


def to_tokens(raw: AnyArray, present: AnyArray, n_joints: int) -> AnyArray:
    """Rows `(..., time, raw size)` seen from the raw row `present` `(..., raw size)`: `(..., time, token size)`."""
    xp = _namespace(raw)
    row = raw_layout(n_joints).split(raw)
    origin = raw_layout(n_joints).split(present[..., None, :])
    yaw = row["yaw"] - origin["yaw"]
    moved = row["displacement"][..., :2] - origin["displacement"][..., :2]
    parts = [
        _rotate(moved, -origin["yaw"][..., 0], xp),
        xp.cos(yaw),
        xp.sin(yaw),
        row["displacement"][..., 2:],
        *(row[name] for name in ("velocity", "angular_velocity", "gravity", "position", "joint_velocity")),
    ]
    return xp.concat(parts, -1)


def to_raw(tokens: AnyArray, present: AnyArray, n_joints: int) -> AnyArray:
    """Inverse of `to_tokens`; the yaw comes back within pi of the present one, since a heading has no turns."""
    xp = _namespace(tokens)
    token = token_layout(n_joints).split(tokens)
    origin = raw_layout(n_joints).split(present[..., None, :])
    heading = token["heading"]
    parts = [
        _rotate(token["displacement"], origin["yaw"][..., 0], xp) + origin["displacement"][..., :2],
        token["height"],
        xp.arctan2(heading[..., 1:], heading[..., :1]) + origin["yaw"],
        *(token[name] for name in ("velocity", "angular_velocity", "gravity", "position", "joint_velocity")),
    ]
    return xp.concat(parts, -1)


def raw_mirror(robot: Robot) -> Mirror:
    """Of a raw row."""
    joints = Mirror.joints(robot)
    planes = Mirror.VECTOR, Mirror.FLIPPED, Mirror.VECTOR, Mirror.ROTATION, Mirror.VECTOR
    return Mirror.join(*planes, joints, joints)


@dataclass(frozen=True)
class Normaliser:
    """Zero mean and unit deviation per feature; `mean` and `std` are both numpy or both torch, `(features,)`."""

    mean: AnyArray
    std: AnyArray

    # A feature that hardly moves would be blown up to noise: deviations below this (rad, m, m/s) count as this.
    FLOOR = 0.01

    @classmethod
    def fit(cls, values: Array) -> Normaliser:
        """From `(samples, features)`."""
        std = np.maximum(values.std(0, dtype=np.float64), cls.FLOOR)
        return cls(values.mean(0, dtype=np.float64).astype(np.float32), std.astype(np.float32))

    def to_torch(self) -> Self:
        """The same with torch tensors."""
        import torch

        return replace(self, **{field.name: torch.as_tensor(getattr(self, field.name)) for field in fields(self)})

    def to_numpy(self) -> dict[str, Array]:
        """Its arrays by name, as a checkpoint stores them."""
        return {field.name: np.asarray(getattr(self, field.name)) for field in fields(self)}

    @staticmethod
    def from_numpy(arrays: Mapping[str, Array]) -> Normaliser:
        """Inverse of `to_numpy`. Raises KeyError or TypeError where arrays are missing or unknown."""
        return Emphasis(**arrays) if "project" in arrays else Normaliser(**arrays)

    def encode(self, x: AnyArray) -> AnyArray:
        return (x - self.mean) / self.std

    def decode(self, x: AnyArray) -> AnyArray:
        return x * self.std + self.mean

    def pull_back(self, gradient: AnyArray) -> AnyArray:
        """The gradient by what is decoded, of a gradient by what it is decoded to."""
        return gradient * self.std

    def decoding(self) -> tuple[Array, Array]:
        """`decode` as a matrix `(inputs, features)` and an offset, numpy: `x @ matrix + offset`, one product."""
        return np.diag(np.asarray(self.std)), np.asarray(self.mean)


def joints_seen(states: Normaliser) -> int:
    """How many joints the tokens describe that `states` normalises."""
    return (len(states.mean) - token_layout(0).size) // 2


GLOBAL_FIELDS = ("displacement", "heading", "height", "velocity", "angular_velocity", "gravity")


@dataclass(frozen=True)
class Emphasis(Normaliser):
    """Normalised states `s` projected to `[A B | I] s`, so that the few global features weigh as much as the joints.

    A is drawn from a normal distribution, B scales global features (Diffuse-CLoC, section 3.1, after
    Karunratanakul et al., arXiv:2305.12577). Rows are divided by their norm, so that all inputs stay of order one.
    `recover` is the least-squares inverse.
    """

    project: AnyArray  # (features, 2 features)
    recover: AnyArray  # (2 features, features)

    @classmethod
    def of(cls, states: Normaliser, n_joints: int, strength: float, seed: int) -> Emphasis:
        """Over `states`, numpy; `strength` is B of the global features. The matrix is kept in the checkpoint."""
        layout = token_layout(n_joints)
        weights = np.ones(layout.size)
        for name in GLOBAL_FIELDS:
            weights[layout.slice(name)] = strength
        mixed = np.random.default_rng(seed).standard_normal((layout.size, layout.size)) * weights
        mixed /= np.linalg.norm(mixed, axis=1, keepdims=True)
        project = np.concatenate([mixed, np.eye(layout.size)]).T
        return cls(states.mean, states.std, project.astype(np.float32), np.linalg.pinv(project).astype(np.float32))

    def encode(self, x: AnyArray) -> AnyArray:
        return super().encode(x) @ self.project

    def decode(self, x: AnyArray) -> AnyArray:
        return super().decode(x @ self.recover)

    def pull_back(self, gradient: AnyArray) -> AnyArray:
        return super().pull_back(gradient) @ self.recover.T

    def decoding(self) -> tuple[Array, Array]:
        return np.asarray(self.recover) * np.asarray(self.std), np.asarray(self.mean)

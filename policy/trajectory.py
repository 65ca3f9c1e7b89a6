"""The predicted future that a guidance cost is about, and costs that know their own gradient."""

from __future__ import annotations

from abc import ABC, abstractmethod
from collections.abc import Callable
from dataclasses import dataclass, replace
from functools import lru_cache
from typing import Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction
from servoid.policy.features import AnyArray, token_layout

# A cost's gradient by the fields of a trajectory that it depends on, each shaped like the field.
Slope = dict[str, Array]


@dataclass(frozen=True)
class Trajectory:
    """The predicted future in physical units, in the heading frame of now: numpy arrays or torch tensors."""

    displacement: AnyArray  # (batch, horizon, 2) m
    yaw: AnyArray  # (batch, horizon) rad
    velocity: AnyArray  # (batch, horizon, 2) m/s, heading frame of its own tick
    yaw_rate: AnyArray  # (batch, horizon) rad/s
    height: AnyArray  # (batch, horizon) m
    gravity: AnyArray  # (batch, horizon, 3) unit vector, base frame
    joints: AnyArray  # (batch, horizon, n_joints) rad
    ticks: Array  # (horizon,) int, ahead of now: at least 1, and rising
    dt: float  # s, length of a tick

    FIELDS = "displacement", "yaw", "velocity", "yaw_rate", "height", "gravity", "joints"  # what is predicted

    @property
    def times(self) -> Array:
        """Of the predicted states, `(horizon,)` s from now."""
        return self.dt * self.ticks

    @property
    def shares(self) -> Array:
        """Of the time that each state stands for, which is that since the one before it: `(horizon,)`, one in all."""
        return _shares(self.ticks.tobytes())

    def mean(self, values: AnyArray, axis: int = -1) -> AnyArray:
        """Mean over time of `values` of the horizon along `axis`, or of its first part."""
        spans = np.diff(self.ticks[: values.shape[axis]], prepend=0)
        weights = (spans / spans.sum()).reshape(-1, *[1] * (-1 - axis))
        return (values * (weights if isinstance(values, np.ndarray) else values.new_tensor(weights))).sum(axis)

    @classmethod
    def of(cls, tokens: AnyArray, n_joints: int, dt: float, ticks: Array | None = None) -> Trajectory:
        """From tokens `(batch, horizon, token size)` in physical units, at `ticks`; None: at 1, 2, ..."""
        at = token_layout(n_joints).slices
        heading = tokens[..., at["heading"]]
        return cls(
            displacement=tokens[..., at["displacement"]],
            yaw=_arctan2(heading[..., 1], heading[..., 0]),
            velocity=tokens[..., at["velocity"]][..., :2],
            yaw_rate=tokens[..., at["angular_velocity"]][..., 2],
            height=tokens[..., at["height"]][..., 0],
            gravity=tokens[..., at["gravity"]],
            joints=tokens[..., at["position"]],
            ticks=np.arange(1, tokens.shape[-2] + 1) if ticks is None else ticks,
            dt=dt,
        )


def by_tokens(slope: Slope, tokens: Array, n_joints: int) -> Array:
    """The gradient by `tokens` `(batch, horizon, token size)` of a cost with this slope on their trajectory."""
    at, gradient = token_layout(n_joints).slices, np.zeros_like(tokens)
    for name, values in slope.items():
        if name == "yaw":
            heading = tokens[..., at["heading"]]
            turn = values / (heading**2).sum(-1)
            gradient[..., at["heading"]] = np.stack([-heading[..., 1] * turn, heading[..., 0] * turn], -1)
        elif name == "velocity":
            gradient[..., at["velocity"]][..., :2] = values
        elif name == "yaw_rate":
            gradient[..., at["angular_velocity"]][..., 2] = values
        elif name == "height":
            gradient[..., at["height"]][..., 0] = values
        else:
            gradient[..., at["position" if name == "joints" else name]] = values
    return gradient


class SlopedCost(ABC):
    """A guidance cost that says its gradient, in numpy. It can be sent to a planner's process (pickle)."""

    @abstractmethod
    def slope(self, trajectory: Trajectory, instruction: Instruction) -> tuple[Array, Slope]:
        """Cost `(batch,)` and its gradient on a trajectory of numpy arrays, in the heading frame of now."""

    def __call__(self, trajectory: Trajectory, instruction: Instruction) -> Array:
        """Cost `(batch,)`."""
        return self.slope(trajectory, instruction)[0]


@dataclass(frozen=True)
class ByAutograd(SlopedCost):
    """A cost that is written with torch: its gradient is torch's."""

    cost: Callable[[Trajectory, Instruction], Any]

    def slope(self, trajectory: Trajectory, instruction: Instruction) -> tuple[Array, Slope]:
        import torch

        fields = Trajectory.FIELDS
        with torch.inference_mode(False), torch.enable_grad():
            leaves: dict[str, Any] = {
                name: torch.tensor(getattr(trajectory, name), requires_grad=True) for name in fields
            }
            cost = self.cost(replace(trajectory, **leaves), instruction)
            gradients = torch.autograd.grad(cost.sum(), list(leaves.values()), allow_unused=True)
        slope = {name: x.numpy() for name, x in zip(fields, gradients, strict=True) if x is not None}
        return cost.detach().numpy(), slope


def sloped(cost: Callable[[Trajectory, Instruction], Any]) -> SlopedCost:
    """The cost with its gradient: its own, or else torch's."""
    return cost if isinstance(cost, SlopedCost) else ByAutograd(cost)


@lru_cache(maxsize=64)  # of each network call
def _shares(ticks: bytes) -> Array:
    spans = np.diff(np.frombuffer(ticks, dtype=np.int64), prepend=0)
    return (spans / spans.sum()).astype(np.float32)


def _arctan2(y: AnyArray, x: AnyArray) -> AnyArray:
    return np.arctan2(y, x) if isinstance(y, np.ndarray) else y.arctan2(x)

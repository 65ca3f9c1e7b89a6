"""The guidance cost of a predicted trajectory: how far it is from moving with a constant twist.

Works on torch tensors through their own methods, so that tasks load without torch.
"""

from __future__ import annotations

from dataclasses import dataclass
from typing import Any, Protocol

import numpy as np

from hw.hal import Array

_STANDING = 1e-3  # m/s and rad/s: an instructed twist below it means to stand


@dataclass(frozen=True)
class Weights:
    """Weights of squared errors."""

    velocity: float = 1.0  # per (m/s)^2
    yaw_rate: float = 0.1  # per (rad/s)^2
    displacement: float = 1.0  # per m^2
    yaw: float = 0.1  # per rad^2
    stand: float = 10.0  # per (m/s)^2 of each tick's velocity, where nothing but standing is asked

    def __post_init__(self) -> None:
        for key in ("velocity", "yaw_rate", "displacement", "yaw", "stand"):
            if getattr(self, key) < 0.0:
                raise ValueError(f"{key}: a weight must not be negative")


class Trajectory(Protocol):
    """A batch of predicted motions, torch tensors. Frame `i` lies `(i + 1) * dt` ahead of now."""

    displacement: Any  # (batch, horizon, 2) m from now, heading frame of now
    yaw: Any  # (batch, horizon) rad from now
    velocity: Any  # (batch, horizon, 2) m/s, each frame's own heading frame, like `State.velocity`
    yaw_rate: Any  # (batch, horizon) rad/s
    dt: float  # s between frames


def integrate_twist(velocity: Array, times: Array) -> tuple[Array, Array]:
    """Displacement `(..., n, 2)` m and yaw `(..., n)` rad after `times (n,)` s of a constant twist.

    `velocity` is `(..., 3)`: m/s forward, m/s left, rad/s in the heading frame, which turns: with w the yaw rate and
    a = w t, x = t (vx sin(a)/a - vy (1 - cos(a))/a) and y = t (vx (1 - cos(a))/a + vy sin(a)/a).
    """
    velocity = np.asarray(velocity, dtype=float)
    forward, left, rate = (velocity[..., i, None] for i in range(3))
    yaw = rate * times
    along = np.sinc(yaw / np.pi)  # sin(a)/a
    across = 0.5 * yaw * np.sinc(0.5 * yaw / np.pi) ** 2  # (1 - cos(a))/a = a/2 (sin(a/2)/(a/2))^2
    x = times * (forward * along - left * across)
    y = times * (forward * across + left * along)
    return np.stack([x, y], axis=-1), yaw


def twist_cost(trajectory: Trajectory, velocity: Array, weights: Weights) -> Any:
    """Weighted squared errors against the twist `velocity` `(3,)` or `(batch, 3)`: `(batch,)`.

    Velocities are compared by their means over the horizon, displacement and yaw at its end. Tick by tick, the sway of
    every walk would be an error, least for a robot that stands. Differentiable with respect to the trajectory.
    """
    end = np.array([trajectory.dt * trajectory.yaw.shape[-1]])
    place, yaw = integrate_twist(velocity, end)
    as_tensor = trajectory.displacement.new_tensor
    twist = as_tensor(np.asarray(velocity, dtype=float))
    cost = weights.velocity * ((trajectory.velocity.mean(-2) - twist[..., :2]) ** 2).sum(-1)
    cost = cost + weights.yaw_rate * (trajectory.yaw_rate.mean(-1) - twist[..., 2]) ** 2
    short = trajectory.displacement[..., -1, :] - as_tensor(place[..., 0, :])
    cost = cost + weights.displacement * (short**2).sum(-1)
    cost = cost + weights.yaw * (trajectory.yaw[..., -1] - as_tensor(yaw[..., 0])) ** 2
    # Stepping on the spot has no mean velocity either: who is told to stand shall not sway.
    stand = as_tensor((np.abs(np.asarray(velocity, dtype=float)).max(-1) < _STANDING).astype(float))
    return cost + stand * weights.stand * (trajectory.velocity**2).sum(-1).mean(-1)

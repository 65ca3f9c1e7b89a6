"""Terms of the guidance cost about how the robot moves: its twist, and its velocity over the ground."""

from __future__ import annotations

from functools import lru_cache

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.policy.trajectory import Slope, Trajectory
from servoid.stack.tasks.terms.weights import Weights

_STANDING = 1e-3  # m/s and rad/s: an instructed twist below it means to stand
_STAND, _STAND_TURN = 10.0, 0.1  # 1/(m/s)^2 and 1/(rad/s)^2, of a robot that shall stand
_SLOW = 0.05  # m/s below which the direction of a motion says little


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


@lru_cache(maxsize=64)  # the same in each network call of a plan
def _end(velocity: bytes, shape: tuple[int, ...], seconds: float) -> tuple[Array, Array, Array]:
    """Displacement `(..., 2)` and yaw `(...)` after so long of a twist, and whether it means to stand `(...)`."""
    twist = np.frombuffer(velocity).reshape(shape)
    place, yaw = integrate_twist(twist, np.array([seconds]))
    return place[..., 0, :], yaw[..., 0], np.abs(twist).max(-1) < _STANDING


def twist_cost(trajectory: Trajectory, velocity: Array, weights: Weights) -> tuple[Array, Slope]:
    """Weighted squared errors against the twist `velocity` `(3,)` or `(batch, 3)`.

    Velocities are compared by their means over the horizon, displacement and yaw at its end. Tick by tick, the sway of
    every walk would be an error, least for a robot that stands.
    """
    w, shares, moving = weights, trajectory.shares, trajectory.velocity
    twist = np.asarray(velocity, dtype=float)
    place, yaw, still = _end(twist.tobytes(), twist.shape, float(trajectory.dt * trajectory.ticks[-1]))
    off = shares @ moving - twist[..., :2]
    turned = trajectory.yaw_rate @ shares - twist[..., 2]
    short = trajectory.displacement[..., -1, :] - place
    askew = trajectory.yaw[..., -1] - yaw
    cost = w.velocity * (off**2).sum(-1) + w.yaw_rate * turned**2
    cost += w.displacement * (short**2).sum(-1) + w.yaw * askew**2
    slope = {
        "velocity": (2.0 * w.velocity * off)[..., None, :] * shares[:, None],
        "yaw_rate": (2.0 * w.yaw_rate * turned)[..., None] * shares,
        "displacement": np.zeros_like(trajectory.displacement),
        "yaw": np.zeros_like(trajectory.yaw),
    }
    slope["displacement"][..., -1, :] = 2.0 * w.displacement * short
    slope["yaw"][..., -1] = 2.0 * w.yaw * askew
    # Stepping on the spot has no mean velocity either: who is told to stand shall not sway.
    if still.any():
        stand = w.stand * still
        cost += stand * ((moving**2).sum(-1) @ shares)
        slope["velocity"] += 2.0 * stand[..., None, None] * shares[:, None] * moving
    return cost, slope


def ground_cost(trajectory: Trajectory, asked: Array, weights: Weights) -> tuple[Array, Slope]:
    """`w1 (|v| - |g|)^2 + w2 (1 - cos(v, g)) + w3 (1 - cos(heading, g))`, for a velocity `(2,)` m/s.

    UniPhys, eq. 6, with v the mean over the horizon: tick by tick, the sway of every walk would be an error. A slow
    motion has hardly a direction, and where standing is asked there is none.
    """
    w, shares = weights, trajectory.shares
    cos, sin = np.cos(trajectory.yaw), np.sin(trajectory.yaw)
    forward, left = trajectory.velocity[..., 0], trajectory.velocity[..., 1]
    x, y = cos * forward - sin * left, sin * forward + cos * left  # over the ground
    mean = np.stack([x @ shares, y @ shares], -1)
    squared, wanted = (mean**2).sum(-1), float(np.linalg.norm(asked))
    speed = np.sqrt(squared + 1e-9)
    cost = w.speed * (speed - wanted) ** 2
    by_mean = (2.0 * w.speed * (speed - wanted) / speed)[..., None] * mean
    by_yaw = np.zeros_like(trajectory.yaw)
    if wanted >= _STANDING:
        way = np.asarray(asked, dtype=float) / wanted
        along, size = mean @ way, np.sqrt(squared + _SLOW**2)
        cost = cost + w.steering * (1.0 - along / size)
        by_mean = by_mean + w.steering * ((along / size**3)[..., None] * mean - way / size[..., None])
        cost = cost + w.heading * ((1.0 - (cos * way[0] + sin * way[1])) @ shares)
        by_yaw = w.heading * shares * (sin * way[0] - cos * way[1])
    by_x, by_y = by_mean[..., :1] * shares, by_mean[..., 1:] * shares
    slope = {
        "velocity": np.stack([by_x * cos + by_y * sin, by_y * cos - by_x * sin], -1),
        "yaw": by_yaw - by_x * y + by_y * x,
    }
    return cost, slope


def standing_cost(trajectory: Trajectory) -> tuple[Array, Slope]:
    """Squared velocity, after the first quarter of the horizon: by then the robot shall stand.

    Who runs and shall stand at once leans back too late and falls on its face; and nobody has to come back to where
    the robot was when it was asked.
    """
    shares = trajectory.shares * (trajectory.ticks > trajectory.ticks[-1] / 4)
    shares = shares / shares.sum()
    cost = _STAND * ((trajectory.velocity**2).sum(-1) @ shares) + _STAND_TURN * (trajectory.yaw_rate**2 @ shares)
    return cost, {
        "velocity": 2.0 * _STAND * shares[:, None] * trajectory.velocity,
        "yaw_rate": 2.0 * _STAND_TURN * shares * trajectory.yaw_rate,
    }

"""Terms of the guidance cost about where the robot is: at a goal, on a path, clear of obstacles."""

from __future__ import annotations

import math

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import DistanceMap
from servoid.policy.trajectory import Slope, Trajectory
from servoid.stack.tasks.terms.weights import Weights

_NEAR = 0.1  # m from a goal within which its bearing says little


def norm(vectors: Array) -> Array:
    """Length of `(..., k)`, with a slope at zero too."""
    length: Array = np.sqrt((vectors**2).sum(-1) + 1e-9)
    return length


def goal_cost(trajectory: Trajectory, goal: Array, weights: Weights) -> tuple[Array, Slope]:
    """Of each tick, for a goal `(2,)` or `(batch, 2)` m.

    `w1 |p - g| + w2 (1 - cos(heading, g - p))` (UniPhys, eq. 5), and `w3 |p - g|^2` (Diffuse-CLoC's G_wp, section 4.1).
    The bearing of a near goal turns with every step, by 1 / d, so facing it is weighted with d^2 / (d^2 + 0.1^2).
    """
    w, shares = weights, trajectory.shares
    way = np.asarray(goal, dtype=float)[..., None, :] - trajectory.displacement  # the same goal for all ticks
    distance, cos, sin = norm(way), np.cos(trajectory.yaw), np.sin(trajectory.yaw)
    ahead = way[..., 0] * cos + way[..., 1] * sin
    room = distance**2 + _NEAR**2
    turned = distance * (distance - ahead) / room
    cost = (w.goal * distance + w.facing * turned + w.waypoint * distance**2) @ shares
    # d(turned) = by_distance d(distance) - by_ahead d(ahead)
    by_distance = w.facing * (2.0 * distance - ahead - 2.0 * distance * turned) / room
    by_ahead = w.facing * distance / room
    pull = shares * (w.goal + 2.0 * w.waypoint * distance + by_distance) / distance
    turn = shares * by_ahead
    slope = {
        "displacement": turn[..., None] * np.stack([cos, sin], -1) - pull[..., None] * way,
        "yaw": turn * (way[..., 0] * sin - way[..., 1] * cos),
    }
    return cost, slope


def way_cost(trajectory: Trajectory, distances: DistanceMap, weights: Weights) -> tuple[Array, Slope]:
    """Distance of each state from the goal by a free way, between the points of the map, and how it faces that way.

    Beyond the map it is that of its rim, and how far away the rim is. Facing counts `along (1 - cos(heading, way))`,
    less and less within some 0.1 m of the goal; the way is where the distance falls most over 0.1 m to each side.
    """
    shares, metres, size = trajectory.shares, np.asarray(distances.metres), distances.size
    cos, sin = math.cos(distances.yaw), math.sin(distances.yaw)
    turn = np.array([[cos, -sin], [sin, cos]]) / size  # of a row, into steps of the map
    at = (trajectory.displacement - np.asarray(distances.corner)) @ turn
    value, by_step = _between(metres, at)
    beyond = at - _inside(metres, at)
    away = np.sqrt((beyond**2).sum(-1) + 1e-9)
    cost = weights.way * ((value + size * (away - math.sqrt(1e-9))) @ shares)
    by_step = by_step * (beyond == 0.0) + size * beyond / away[..., None]
    slope = {"displacement": weights.way * shares[:, None] * (by_step @ turn.T)}
    if weights.along > 0.0:
        steps = np.array([[1.0, 0.0], [0.0, 1.0]]) * _NEAR / size
        falls = np.stack([_between(metres, at - step)[0] - _between(metres, at + step)[0] for step in steps], -1)
        way = falls @ turn.T / norm(falls @ turn.T)[..., None]
        ahead, left = np.cos(trajectory.yaw), np.sin(trajectory.yaw)
        counts = weights.along * shares * value**2 / (value**2 + _NEAR**2)
        cost = cost + (counts * (1.0 - ahead * way[..., 0] - left * way[..., 1])).sum(-1)
        slope["yaw"] = counts * (left * way[..., 0] - ahead * way[..., 1])
    return cost, slope


def _inside(metres: Array, at: Array) -> Array:
    """The points of a map `(n, m)` nearest to `at` `(..., 2)`, in its steps."""
    inside: Array = np.clip(at, 0.0, np.array(metres.shape) - 1.001)
    return inside


def _between(metres: Array, at: Array) -> tuple[Array, Array]:
    """A map's value at points `(..., 2)`, in its steps, by the four around each, and its slope `(..., 2)` by step."""
    inside = _inside(metres, at)
    i, j = np.moveaxis(inside.astype(int), -1, 0)
    u, v = np.moveaxis(inside - np.floor(inside), -1, 0)
    a, b, c, d = metres[i, j], metres[i, j + 1], metres[i + 1, j], metres[i + 1, j + 1]
    low, high = a + v * (b - a), c + v * (d - c)
    return low + u * (high - low), np.stack([high - low, (1.0 - u) * (b - a) + u * (d - c)], -1)


def path_cost(trajectory: Trajectory, path: Array, weights: Weights) -> tuple[Array, Slope]:
    """Squared distance of each tick from its place on the path `(n, 2)` m (Diffuse-CLoC, eq. 5).

    Ticks beyond the end of the path are not compared.
    """
    places = np.asarray(path, dtype=float)
    count = int((trajectory.ticks <= len(places)).sum())
    slope = np.zeros_like(trajectory.displacement)
    if not count:
        return np.zeros(slope.shape[:-2]), {}
    shares = trajectory.shares[:count] / trajectory.shares[:count].sum()
    off = trajectory.displacement[..., :count, :] - places[trajectory.ticks[:count] - 1]
    slope[..., :count, :] = 2.0 * weights.path * shares[:, None] * off
    return weights.path * ((off**2).sum(-1) @ shares), {"displacement": slope}


def obstacle_cost(trajectory: Trajectory, obstacles: Array, weights: Weights) -> tuple[Array, Slope]:
    """Closeness to obstacles `(n, 5)` that move with constant velocity, summed over them.

    With d the signed distance of the body from an obstacle, `exp(-c d)` (Diffuse-CLoC, eq. 3 and 4), and
    `softplus(1 - d / margin)` (UniPhys, eq. 7, whose margin is 1 m). The body is its middle alone or, with a `width`, a
    bar across the heading with round ends, `depth` thick to either side. With a `safe` distance `exp(-c d)` counts by
    what it is more than there, and d as zero inside an obstacle: nobody is there, and its slope would outgrow all else.
    """
    w, shares = weights, trajectory.shares[:, None]
    centre, radius, velocity = np.split(np.asarray(obstacles, dtype=float), [2, 3], axis=-1)
    centres = centre + trajectory.times[:, None, None] * velocity  # (horizon, n, 2)
    apart = trajectory.displacement[..., None, :] - centres
    cos, sin = np.cos(trajectory.yaw)[..., None], np.sin(trajectory.yaw)[..., None]
    # In the body's own frame: what is along its heading, and what is across and beyond its sides.
    along, across = cos * apart[..., 0] + sin * apart[..., 1], cos * apart[..., 1] - sin * apart[..., 0]
    half = max(w.width - w.depth, 0.0)
    beside = across - np.clip(across, -half, half)
    length = np.sqrt(along**2 + beside**2 + 1e-9)
    distance = length - radius[:, 0] - w.depth
    if w.safe > 0.0:
        near = np.exp(-w.sharpness * np.clip(distance, 0.0, w.safe))
        cost = w.repulsion * (near - math.exp(-w.sharpness * w.safe))
        counts = (distance > 0.0) & (distance < w.safe)
        by_distance = -w.repulsion * w.sharpness * near * counts
    else:
        cost = w.repulsion * np.exp(-w.sharpness * distance)
        by_distance = -w.sharpness * cost
    if w.avoidance > 0.0:
        grown = np.exp(1.0 - distance / w.margin)
        cost = cost + w.avoidance * np.log1p(grown)
        by_distance = by_distance - w.avoidance / w.margin * grown / (1.0 + grown)
    pull = shares * by_distance / length
    ahead, aside = pull * along, pull * beside
    slope = {
        "displacement": np.stack([cos * ahead - sin * aside, sin * ahead + cos * aside], -1).sum(-2),
        "yaw": (ahead * across - aside * along).sum(-1),
    }
    return (cost * shares).sum((-2, -1)), slope

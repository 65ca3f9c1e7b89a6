"""The guidance cost of a predicted trajectory: a weighted sum of terms, each for one thing that an instruction holds.

Works on torch tensors through their own methods, so that tasks load without torch.
"""

from __future__ import annotations

import math
from collections.abc import Callable
from dataclasses import dataclass
from typing import Annotated, Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import DistanceMap, Instruction
from servoid.hw.setting import Setting, check
from servoid.policy.features import Trajectory

_STANDING = 1e-3  # m/s and rad/s: an instructed twist below it means to stand
_SLOW = 0.05  # m/s below which the direction of a motion says little
_NEAR = 0.1  # m from a goal within which its bearing says little


@dataclass(frozen=True)
class Weights:
    """Weights of the terms of the guidance cost, and the two lengths that shape those about obstacles."""

    velocity: Annotated[float, Setting("squared error of the mean velocity", "1/(m/s)^2", least=0)] = 1.0
    yaw_rate: Annotated[float, Setting("squared error of the mean turning rate", "1/(rad/s)^2", least=0)] = 0.1
    displacement: Annotated[float, Setting("squared error of where the motion ends", "1/m^2", least=0)] = 1.0
    yaw: Annotated[float, Setting("squared error of the heading at the end", "1/rad^2", least=0)] = 0.1
    stand: Annotated[float, Setting("squared velocity, where it shall stand", "1/(m/s)^2", least=0)] = 10.0
    speed: Annotated[float, Setting("squared error of the speed over the ground", "1/(m/s)^2", least=0)] = 0.0
    steering: Annotated[float, Setting("1 - cos(angle between velocity and the one asked)", least=0)] = 0.0
    heading: Annotated[float, Setting("1 - cos(angle between heading and velocity asked)", least=0)] = 0.0
    goal: Annotated[float, Setting("distance from the goal", "1/m", least=0)] = 0.0
    facing: Annotated[float, Setting("1 - cos(bearing of the goal), less within 0.1 m of it", least=0)] = 0.0
    waypoint: Annotated[float, Setting("squared distance from the goal", "1/m^2", least=0)] = 0.0
    path: Annotated[float, Setting("squared distance from the place on the path", "1/m^2", least=0)] = 10.0
    way: Annotated[float, Setting("distance from the goal by a free way", "1/m", least=0)] = 0.0
    repulsion: Annotated[float, Setting("exp(-sharpness distance), for each obstacle", least=0)] = 0.1
    sharpness: Annotated[float, Setting("how steeply repulsion falls", "1/m", above=0)] = 15.0
    avoidance: Annotated[float, Setting("softplus(1 - distance / margin), for each obstacle", least=0)] = 0.0
    margin: Annotated[float, Setting("distance at which avoidance sets in", "m", above=0)] = 0.275
    width: Annotated[
        float, Setting("from the robot's middle to its side, for obstacles; 0: its middle alone", "m", least=0)
    ] = 0.0
    depth: Annotated[float, Setting("from the robot's middle to its front", "m", least=0)] = 0.0
    safe: Annotated[float, Setting("distance at which repulsion ends; 0: it has no end", "m", least=0)] = 0.0

    def __post_init__(self) -> None:
        check(self)
        if self.depth > self.width:
            raise ValueError(f"depth: {self.depth:g} must not be more than width ({self.width:g})")

    @property
    def twist(self) -> bool:
        """Whether any term counts that is about the velocity, which every instruction holds."""
        return any((self.velocity, self.yaw_rate, self.displacement, self.yaw, self.stand))


_STAND = Weights()


@dataclass(frozen=True)
class FreeWeights(Weights):
    """Weights for a planner that finds the way by itself: no velocity that a script asks for counts by default."""

    velocity: Annotated[float, Setting("squared error of the mean velocity", "1/(m/s)^2", least=0)] = 0.0
    yaw_rate: Annotated[float, Setting("squared error of the mean turning rate", "1/(rad/s)^2", least=0)] = 0.0
    displacement: Annotated[float, Setting("squared error of where the motion ends", "1/m^2", least=0)] = 0.0
    yaw: Annotated[float, Setting("squared error of the heading at the end", "1/rad^2", least=0)] = 0.0
    stand: Annotated[float, Setting("squared velocity, where it shall stand", "1/(m/s)^2", least=0)] = 0.0


def total_cost(trajectory: Trajectory, instruction: Instruction, weights: Weights) -> Any:
    """Sum `(batch,)` of the terms of everything that the instruction holds.

    The terms for goal, path and obstacles are means over the horizon, so that weights do not depend on its length.
    """
    cost = twist_cost(trajectory, instruction.velocity, weights)
    if instruction.ground is not None and (weights.speed > 0.0 or weights.steering > 0.0 or weights.heading > 0.0):
        cost = cost + ground_cost(trajectory, instruction.ground, weights)
    if instruction.goal is not None and (weights.goal > 0.0 or weights.facing > 0.0 or weights.waypoint > 0.0):
        cost = cost + goal_cost(trajectory, instruction.goal, weights)
    if instruction.distances is not None and weights.way > 0.0:
        cost = cost + way_cost(trajectory, instruction.distances, weights)
    if instruction.path is not None:
        cost = cost + path_cost(trajectory, instruction.path, weights)
    if instruction.obstacles is not None and len(instruction.obstacles):
        cost = cost + obstacle_cost(trajectory, instruction.obstacles, weights)
    return cost


@dataclass(frozen=True)
class Stopping:
    """A task's cost, until the robot shall stand: then standing is all that counts.

    With a cost of places alone nothing else asks for it, and a robot walks on while it is lowered.
    """

    cost: Callable[[Trajectory, Instruction], Any]

    def __call__(self, trajectory: Trajectory, instruction: Instruction) -> Any:
        if instruction.stand:
            return twist_cost(trajectory, np.zeros(3), _STAND)
        return self.cost(trajectory, instruction)


def goal_cost(trajectory: Trajectory, goal: Array, weights: Weights) -> Any:
    """Of each tick, for a goal `(2,)` or `(batch, 2)` m: `(batch,)`.

    `w1 |p - g| + w2 (1 - cos(heading, g - p))` (UniPhys, eq. 5), and `w3 |p - g|^2` (Diffuse-CLoC's G_wp, section 4.1).
    The bearing of a near goal turns with every step, by 1 / d, so facing it is weighted with d^2 / (d^2 + 0.1^2).
    """
    place = np.asarray(goal, dtype=float)[..., None, :]  # the same for all ticks
    way = trajectory.displacement.new_tensor(place) - trajectory.displacement
    distance = _norm(way)
    ahead = way[..., 0] * trajectory.yaw.cos() + way[..., 1] * trajectory.yaw.sin()
    turned = distance * (distance - ahead) / (distance**2 + _NEAR**2)
    return trajectory.mean(weights.goal * distance + weights.facing * turned + weights.waypoint * distance**2)


def ground_cost(trajectory: Trajectory, asked: Array, weights: Weights) -> Any:
    """`w1 (|v| - |g|)^2 + w2 (1 - cos(v, g)) + w3 (1 - cos(heading, g))`, for a velocity `(2,)` m/s: `(batch,)`.

    UniPhys, eq. 6, with v the mean over the horizon: tick by tick, the sway of every walk would be an error. A slow
    motion has hardly a direction, and where standing is asked there is none.
    """
    cos, sin = trajectory.yaw.cos(), trajectory.yaw.sin()
    forward, left = trajectory.velocity[..., 0], trajectory.velocity[..., 1]
    along, across = trajectory.mean(cos * forward - sin * left), trajectory.mean(sin * forward + cos * left)
    squared, wanted = along**2 + across**2, float(np.linalg.norm(asked))
    cost = weights.speed * ((squared + 1e-9).sqrt() - wanted) ** 2
    if wanted < _STANDING:
        return cost
    x, y = (float(part) / wanted for part in asked)
    cost = cost + weights.steering * (1.0 - (along * x + across * y) / (squared + _SLOW**2).sqrt())
    return cost + weights.heading * trajectory.mean(1.0 - (cos * x + sin * y))


def way_cost(trajectory: Trajectory, distances: DistanceMap, weights: Weights) -> Any:
    """Distance of each state from the goal by a free way, between the points of the map: `(batch,)`.

    Beyond the map it is that of its rim, and how far away the rim is.
    """
    place = trajectory.displacement.new_tensor(distances.corner)
    metres = trajectory.displacement.new_tensor(distances.metres)
    x, y = (trajectory.displacement - place).unbind(-1)
    cos, sin = math.cos(distances.yaw), math.sin(distances.yaw)
    at = [(cos * x + sin * y) / distances.size, (cos * y - sin * x) / distances.size]
    inside = [part.clamp(0.0, count - 1.001) for part, count in zip(at, metres.shape, strict=True)]
    (i, j), (u, v) = (part.long() for part in inside), (part - part.floor() for part in inside)
    low = (1.0 - v) * metres[i, j] + v * metres[i, j + 1]
    high = (1.0 - v) * metres[i + 1, j] + v * metres[i + 1, j + 1]
    beyond = sum((part - kept) ** 2 for part, kept in zip(at, inside, strict=True))
    away = distances.size * ((beyond + 1e-9).sqrt() - math.sqrt(1e-9))
    return weights.way * trajectory.mean((1.0 - u) * low + u * high + away)


def path_cost(trajectory: Trajectory, path: Array, weights: Weights) -> Any:
    """Squared distance of each tick from its place on the path `(n, 2)` m (Diffuse-CLoC, eq. 5): `(batch,)`.

    Ticks beyond the end of the path are not compared.
    """
    places = np.asarray(path, dtype=float)
    ticks = trajectory.ticks[trajectory.ticks <= len(places)]
    wanted = trajectory.displacement.new_tensor(places[ticks - 1])
    return weights.path * trajectory.mean(((trajectory.displacement[..., : len(ticks), :] - wanted) ** 2).sum(-1))


def obstacle_cost(trajectory: Trajectory, obstacles: Array, weights: Weights) -> Any:
    """Closeness to obstacles `(n, 5)` that move with constant velocity, summed over them: `(batch,)`.

    With d the signed distance of the body from an obstacle, `exp(-c d)` (Diffuse-CLoC, eq. 3 and 4), and
    `softplus(1 - d / margin)` (UniPhys, eq. 7, whose margin is 1 m). The body is its middle alone or, with a `width`, a
    bar across the heading with round ends, `depth` thick to either side. With a `safe` distance `exp(-c d)` counts by
    what it is more than there, and d as zero inside an obstacle: nobody is there, and its slope would outgrow all else.
    """
    as_tensor = trajectory.displacement.new_tensor
    centre, radius, velocity = np.split(np.asarray(obstacles, dtype=float), [2, 3], axis=-1)
    centres = as_tensor(centre + trajectory.times[:, None, None] * velocity)  # (horizon, n, 2)
    apart = trajectory.displacement[..., None, :] - centres
    if weights.width > 0.0:
        apart = _from_bar(apart, trajectory.yaw[..., None], weights.width - weights.depth)
    distance = _norm(apart) - as_tensor(radius[:, 0]) - weights.depth
    if weights.safe > 0.0:
        near = (-weights.sharpness * distance.clamp(0.0, weights.safe)).exp()
        cost = weights.repulsion * (near - math.exp(-weights.sharpness * weights.safe))
    else:
        cost = weights.repulsion * (-weights.sharpness * distance).exp()
    if weights.avoidance > 0.0:
        cost = cost + weights.avoidance * (1.0 + (1.0 - distance / weights.margin).exp()).log()
    return trajectory.mean(cost.sum(-1))


def _from_bar(vectors: Any, yaw: Any, half: float) -> Any:
    """`vectors` `(..., 2)` m from a bar of `half` a length to either side of its middle, whose normal has that `yaw`.

    They are in the bar's own frame, and begin at its nearest point.
    """
    cos, sin = yaw.cos()[..., None], yaw.sin()[..., None]
    x, y = vectors[..., :1], vectors[..., 1:]
    across = cos * y - sin * x
    beside = across - across.clamp(-half, half)
    return (cos * x + sin * y) * vectors.new_tensor([1.0, 0.0]) + beside * vectors.new_tensor([0.0, 1.0])


def _norm(vectors: Any) -> Any:
    """Length of `(..., 2)`, with a gradient at zero too."""
    return ((vectors**2).sum(-1) + 1e-9).sqrt()


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
    place, yaw = integrate_twist(velocity, trajectory.times[-1:])
    as_tensor = trajectory.displacement.new_tensor
    twist = as_tensor(np.asarray(velocity, dtype=float))
    cost = weights.velocity * ((trajectory.mean(trajectory.velocity, -2) - twist[..., :2]) ** 2).sum(-1)
    cost = cost + weights.yaw_rate * (trajectory.mean(trajectory.yaw_rate) - twist[..., 2]) ** 2
    short = trajectory.displacement[..., -1, :] - as_tensor(place[..., 0, :])
    cost = cost + weights.displacement * (short**2).sum(-1)
    cost = cost + weights.yaw * (trajectory.yaw[..., -1] - as_tensor(yaw[..., 0])) ** 2
    # Stepping on the spot has no mean velocity either: who is told to stand shall not sway.
    stand = as_tensor((np.abs(np.asarray(velocity, dtype=float)).max(-1) < _STANDING).astype(float))
    return cost + stand * weights.stand * trajectory.mean((trajectory.velocity**2).sum(-1))

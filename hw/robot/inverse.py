"""Inverse kinematics of legs of any build, batched: a quadratic guess, made better by Newton's method.

Joints that legs share, such as a waist, stay at home. Where a leg has too few joints to put its foot anywhere, the
foot's place and pitch go first, then its roll, then its yaw; where it has more than it needs, it keeps near its home.
"""

from __future__ import annotations

from dataclasses import dataclass
from itertools import combinations_with_replacement

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.geometry import rotation_matrix
from servoid.hw.robot.description import Robot
from servoid.hw.robot.legs import LegInverse, Legs

_SAMPLES, _SEARCH, _STEPS = 800, 40, 4  # targets of the guess's fit, Newton steps for each, and steps at run time
_ROW = np.array([0, 1, 2, 4, 3, 5])  # what goes first: place, pitch, roll, yaw
_LEVER = 0.1  # m: a radian of the foot's turn counts as much
_WEAK = 0.02  # weight of what the leg cannot serve beside the rest
_DAMPING, _POSTURE = 1e-6, 1e-6  # m2
_LARGEST = 0.3  # rad that a joint goes in a step


class NumericInverse:
    """Like `LegInverse`, for legs of any build."""

    def __init__(self, robot: Robot, legs: Legs) -> None:
        self._legs = legs
        self._free = legs.own
        if not self._free.any(-1).all():
            raise ConfigError(f"{robot.name}: a leg has no joint of its own: all of them are shared with another leg")
        margin = robot.limits.margin
        self._lower, self._upper = legs.pick(robot.lower) + margin, legs.pick(robot.upper) - margin
        self._home = np.clip(legs.pick(robot.home), self._lower, self._upper)
        self._place, self._turn, _, _ = legs.forward(self._home)
        stance = stance_at_home(robot, legs)
        self.hip = stance.hip
        self._size = stance.height  # m
        middle = (self._lower + self._upper) / 2
        self._seed = self._home + 0.15 * (middle - self._home) * self._free  # off a straight knee
        self._weight = self._weights()
        self._fit = self._fitted()

    def __call__(self, ankle: Array, rotation: Array) -> Array:
        """Leg joints `(..., n_legs, joints)` rad that put the feet's frames at `ankle` `(..., n_legs, 3)` m, turned by
        `rotation` `(..., n_legs, 3, 3)`, within the joints' ranges and as near as the legs reach."""
        features = self._features(ankle, rotation)
        guess = np.einsum("...lf,lfj->...lj", features, self._fit)
        return self._solve(np.clip(guess, self._lower, self._upper), ankle, rotation, _STEPS)

    def _solve(self, q: Array, ankle: Array, rotation: Array, steps: int) -> Array:
        """Levenberg-Marquardt on place and turn, with a light pull to the home pose."""
        weight, free = self._weight, self._free[:, None, :]
        for _ in range(steps):
            at, turn, origins, axes = self._legs.forward(q)
            between = rotation @ np.swapaxes(turn, -1, -2)
            twist = 0.5 * np.stack([between[..., j, i] - between[..., i, j] for i, j in ((1, 2), (2, 0), (0, 1))], -1)
            error = weight * np.concatenate([ankle - at, twist], -1)
            lever = np.cross(axes, at[..., None, :] - origins)
            jacobian = np.swapaxes(np.concatenate([lever, axes], -1), -1, -2) * weight[..., None] * free
            transposed = np.swapaxes(jacobian, -1, -2)
            normal = transposed @ jacobian + (_DAMPING + _POSTURE) * np.eye(q.shape[-1])
            wanted = (transposed @ error[..., None])[..., 0] + _POSTURE * (self._home - q)
            step = np.linalg.solve(normal, wanted[..., None])[..., 0] * self._free
            q = np.clip(q + np.clip(step, -_LARGEST, _LARGEST), self._lower, self._upper)
        return q

    def _weights(self) -> Array:
        """Of place and turn `(legs, 6)`: weak where the leg cannot serve them beside those that go first."""
        rng = np.random.default_rng(0)
        weights = np.full((len(self._home), 6), _WEAK)
        for leg in range(len(weights)):
            best = 0
            for _ in range(10):  # one pose may be singular
                q = self._seed + 0.2 * rng.standard_normal(self._seed.shape)
                at, _, origins, axes = self._legs.forward(np.clip(q, self._lower, self._upper))
                lever = np.cross(axes, at[:, None] - origins)[leg].T / _LEVER
                rows = np.concatenate([lever, axes[leg].T])[_ROW] * self._free[leg]
                kept: list[int] = []
                for row in range(6):
                    part = rows[[*kept, row]]
                    if np.linalg.svd(part, compute_uv=False)[-1] > 0.05:
                        kept.append(row)
                if len(kept) > best:
                    best, weights[leg] = len(kept), _WEAK
                    weights[leg, _ROW[kept]] = 1.0
        weights[:, 3:] *= _LEVER
        return weights

    def _features(self, ankle: Array, rotation: Array) -> Array:
        """All products of up to two of: 1, the place beside that at home, and the turn from that at home."""
        between = rotation @ np.swapaxes(self._turn, -1, -2)
        turn = 0.5 * np.stack([between[..., j, i] - between[..., i, j] for i, j in ((1, 2), (2, 0), (0, 1))], -1)
        x = np.concatenate([np.ones((*turn.shape[:-1], 1)), (ankle - self._place) / self._size, turn], -1)
        i, j = (np.array(k) for k in zip(*combinations_with_replacement(range(7), 2), strict=True))
        return x[..., i] * x[..., j]

    def _fitted(self) -> Array:
        """Coefficients of the guess `(legs, features, joints)`, by least squares on poses around home."""
        rng = np.random.default_rng(0)
        spread = self._size * np.array([0.35, 0.2, 0.2])
        shape = (_SAMPLES, len(self._home))
        ankle = self._place + rng.uniform(-spread, spread, (*shape, 3)) + [0.0, 0.0, 0.1 * self._size]
        half = 0.5 * rng.uniform(-1.0, 1.0, (*shape, 3)) * [0.2, 0.3, 0.5]
        real = np.sqrt(1.0 - (half**2).sum(-1, keepdims=True))
        rotation = rotation_matrix(np.concatenate([real, half], -1)) @ self._turn
        q = self._solve(np.broadcast_to(self._seed, (*shape, self._seed.shape[1])).copy(), ankle, rotation, _SEARCH)
        at = self._legs.forward(q)[0]
        good = np.linalg.norm(at - ankle, axis=-1) < 0.02 * self._size
        features = self._features(ankle, rotation)
        result = np.zeros((shape[1], features.shape[-1], q.shape[-1]))
        result[:, 0] = self._home
        for leg in range(shape[1]):
            rows = good[:, leg]
            if rows.sum() > 2 * features.shape[-1]:
                result[leg] = np.linalg.lstsq(features[rows, leg], q[rows, leg], rcond=None)[0]
        return result


@dataclass(frozen=True)
class HomeStance:
    """How a robot stands at home, seen from an upright frame at its base: of each leg its first joint that pitches, the
    hip, and its last joint, `(legs, 3)` m; and by how far the base leans forward [rad]."""

    hip: Array
    ankle: Array
    lean: float

    @property
    def height(self) -> float:
        """How far the last joints are below the hips [m]."""
        return float(np.abs(self.hip[:, 2] - self.ankle[:, 2]).max()) + 1e-3


def stance_at_home(robot: Robot, legs: Legs) -> HomeStance:
    """The stance at the home pose."""
    ankle, _, origins, axes = legs.forward(legs.pick(robot.home))
    turn = rotation_matrix(legs.stand(robot.home)[1])
    pitch = np.abs(axes[..., 1]) > 0.7
    first = np.where(pitch.any(-1), pitch.argmax(-1), 0)
    hip = np.take_along_axis(origins, first[:, None, None], 1)[:, 0]
    return HomeStance(hip @ turn.T, ankle @ turn.T, float(np.arctan2(turn[0, 2], turn[2, 2])))


def leg_inverse(robot: Robot) -> LegInverse | NumericInverse:
    """The analytic inverse where the robot's legs allow it, else the numeric one."""
    legs = Legs(robot)
    return LegInverse(legs, robot.name) if LegInverse.misfit(legs) is None else NumericInverse(robot, legs)

"""Orientation from gyro and accelerometer: a complementary filter that learns the gyro's bias while the robot stands.

Quaternions are `(..., 4)` w x y z, base to odometry frame. The filter is R. Mahony's (Nonlinear complementary filters
on the special orthogonal group, 2008), without its integral term: standing still gives a better bias.
"""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import cross, headed, multiply, up_vector, yaw_of

_GRAVITY = 9.81
_CORRECTION = 0.5  # 1/s: how fast the accelerometer turns the estimate
_TRUST = 3.0  # m/s2: a specific force this far from gravity halves the correction
_STILL_RATE = 0.06  # rad/s: gyro and joints below it for long enough mean that the robot stands
_STILL_JOINTS = 0.15  # rad/s
_STILL_TIME = 0.3  # s
_FIRST = 0.5  # s of standing after which a bias is known
_BIAS_MEMORY = 3.0  # s of standing that the bias is averaged over


class Attitude:
    """Orientation of one robot or of many worlds; `shape` are the leading dimensions."""

    def __init__(self, dt: float, shape: tuple[int, ...] = ()) -> None:
        self._dt, self._shape = dt, shape
        self.quaternion = np.zeros((*shape, 4))
        self.bias = np.zeros((*shape, 3))
        self.yaw = np.zeros(shape)
        self.learns = True  # whether it may be standing, and so learn the gyro's bias
        self._still = np.zeros(shape)
        self._seen = np.zeros(shape)
        self.reset(np.ones(shape, bool), np.zeros((*shape, 3)))

    def reset(self, where: Array, specific_force: Array, bias: Array | None = None) -> None:
        """Start where the accelerometer says is up, heading zero. `bias` `(..., 3)` rad/s, where one is known."""
        up = np.where(np.linalg.norm(specific_force, axis=-1, keepdims=True) > 1.0, specific_force, [0.0, 0.0, 1.0])
        up = up / np.linalg.norm(up, axis=-1, keepdims=True)
        # The shortest turn that takes the measured up to z.
        q = np.stack([1 + up[..., 2], up[..., 1], -up[..., 0], np.zeros_like(up[..., 0])], -1)
        q = np.where(up[..., 2:] < -1 + 1e-9, [0.0, 1.0, 0.0, 0.0], q)  # on its head any half turn is the shortest
        q = q / np.linalg.norm(q, axis=-1, keepdims=True)
        q = headed(q, -yaw_of(q))
        self.quaternion = np.where(where[..., None], q, self.quaternion)
        self.bias = np.where(where[..., None], 0.0 if bias is None else bias, self.bias)
        self.yaw = np.where(where, 0.0, self.yaw)
        self._still = np.where(where, 0.0, self._still)
        # A bias that was given counts as a full memory.
        self._seen = np.where(where, 0.0 if bias is None else _BIAS_MEMORY, self._seen)

    def level(self, specific_force: Array, yaw: Array) -> None:
        """Take up anew from the accelerometer, facing `yaw` `(...,)` rad give or take whole turns; keep the bias."""
        facing, bias, seen = yaw_of(self.quaternion), self.bias, self._seen
        self.reset(np.ones(self._shape, bool), specific_force, bias)
        self._seen = seen
        self.quaternion = headed(self.quaternion, facing)
        self.yaw = yaw + (facing - yaw + np.pi) % (2 * np.pi) - np.pi

    def update(
        self,
        gyro: Array,
        specific_force: Array,
        joint_velocity: Array,
        leaning: Array | float = 0.0,
        ticks: int = 1,
    ) -> Array:
        """Go on by `ticks`; returns the angular velocity without bias `(..., 3)` rad/s. NaN inputs coast.

        `leaning` `(..., 3)` rad/s is how fast the base turns over standing feet, by the legs.
        """
        dt = self._dt * ticks
        rate = np.where(np.isfinite(gyro), gyro - self.bias, 0.0)
        self._learn_bias(gyro, rate, joint_velocity, leaning, dt)
        norm = np.linalg.norm(specific_force, axis=-1, keepdims=True)
        good = np.isfinite(norm) & (norm > 1.0)
        measured = np.where(good, specific_force / np.where(good, norm, 1.0), 0.0)
        trust = np.where(good, 1.0 / (1.0 + (np.where(good, norm - _GRAVITY, 0.0) / _TRUST) ** 2), 0.0)
        turn = rate + _CORRECTION * trust * cross(measured, up_vector(self.quaternion))
        angle = 0.5 * dt * turn
        step = np.concatenate([np.ones((*self._shape, 1)), angle], -1)
        q = multiply(self.quaternion, step)
        self.quaternion = q / np.linalg.norm(q, axis=-1, keepdims=True)
        change = yaw_of(self.quaternion) - self.yaw
        self.yaw = self.yaw + (change + np.pi) % (2 * np.pi) - np.pi
        return rate

    def _learn_bias(self, gyro: Array, rate: Array, joint_velocity: Array, leaning: Array | float, dt: float) -> None:
        """Average the gyro while the robot stands. A soft robot creeps for seconds: what its legs say is no bias."""
        quiet = (np.abs(joint_velocity) < _STILL_JOINTS).all(-1)
        judged = np.where((self._seen < _FIRST)[..., None], gyro, rate)  # a few ticks' mean is no bias to judge by
        quiet &= (np.linalg.norm(judged, axis=-1) < _STILL_RATE) & np.isfinite(gyro).all(-1) & self.learns
        self._still = np.where(quiet, self._still + dt, 0.0)
        learn = self._still > _STILL_TIME
        self._seen = np.where(learn, np.minimum(self._seen + dt, _BIAS_MEMORY), self._seen)
        share = np.where(learn, dt / np.maximum(self._seen, dt), 0.0)[..., None]
        self.bias = self.bias + share * np.where(np.isfinite(gyro), gyro - leaning - self.bias, 0.0)

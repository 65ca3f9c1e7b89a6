"""State from what a rig has: IMU, joints and leg kinematics. No simulator state enters, in training or at run time.

The base moves as its standing foot says: the foot point nearest the ground is taken as fixed, weighted softly between
feet and corners. Soles slip systematically, so a small network corrects the velocity from the recent past
(stack/estimation/odometry.py); it was trained in randomised worlds. One estimator serves one robot or many worlds.
"""

from __future__ import annotations

from dataclasses import replace

import numpy as np

from servoid.hw.contracts.body import Array, Observation
from servoid.hw.contracts.control import State
from servoid.hw.geometry import cross, headed, joined, turned, up_vector
from servoid.hw.robot.description import Robot
from servoid.hw.robot.legs import Legs
from servoid.policy.mlp import Mlp
from servoid.stack.estimation.attitude import Attitude
from servoid.stack.estimation.odometry import OdometryFeatures

_GRAVITY = 9.81  # m/s2
_CORNER_SOFTNESS = 0.003  # m of height over which corners share the contact
FOOT_SOFTNESS = 0.001  # m of height over which feet share the load


class Estimator:
    """`shape` are the leading dimensions of all arrays; `odometry` None leaves plain leg odometry."""

    def __init__(self, robot: Robot, odometry: Mlp | None = None, shape: tuple[int, ...] = ()) -> None:
        self.robot, self.shape, self._odometry = robot, shape, odometry
        self._legs = Legs(robot)
        self._attitude = Attitude(robot.dt, shape)
        n = len(robot.joints)
        self.features = OdometryFeatures(robot, shape)
        self._displacement = np.zeros((*shape, 3))
        self._heading0 = np.zeros(shape)
        self._position, self._velocity = np.zeros((*shape, n)), np.zeros((*shape, n))
        self.leg_velocity = np.zeros((*shape, 3))
        self._pending = np.ones(shape, bool)
        self._bias: Array | None = None
        self._soles: Array | None = None  # their orientations in the base frame at the tick before
        self._seen = np.zeros(shape, bool)  # worlds where they are of this episode
        self._fallen_yaw: Array | None = None  # rad, of a robot that lies: its heading as it fell
        self._force = np.zeros((*shape, 3))  # m/s2, the last specific force that was read

    def reset(self, where: Array | None = None, bias: Array | None = None) -> None:
        """Forget everything in the worlds `where` (default: all); the next observation starts anew.

        `bias` `(..., 3)` rad/s stands for a calibration that a rig does while it stands before a run.
        """
        where = np.ones(self.shape, bool) if where is None else where
        self._pending = self._pending | where
        if bias is not None:
            old = np.zeros_like(bias) if self._bias is None else self._bias
            self._bias = np.where(where[..., None], bias, old)

    def reset_odometry(self) -> None:
        """Make here and the present heading the origin of the odometry frame."""
        self._displacement = np.zeros((*self.shape, 3))
        self._heading0 = self._attitude.yaw.copy()

    def fall(self) -> None:
        """From now on the robot lies, or rolls on the ground: its legs say nothing of how it moves, and it is taken to
        stay where it fell. Orientation goes on, on the bias that the gyro is known to have."""
        self._fallen_yaw = self._attitude.yaw.copy()
        self._attitude.learns = False

    def stand(self) -> None:
        """It stands again, still: gravity is what the accelerometer says now, and odometry goes on from where the robot
        fell, with the heading that the gyro kept."""
        if self._fallen_yaw is not None:
            self._attitude.level(self._force, self._fallen_yaw)
        self._fallen_yaw, self._attitude.learns = None, True
        self.features.reset(np.ones(self.shape, bool))
        self._seen = np.zeros(self.shape, bool)

    def update(self, observation: Observation, applied: Array, ticks: int = 1) -> State:
        """Estimate from one observation. `applied` `(..., n_joints)` rad is what was commanded last.

        A joint that was not read keeps its last value. `ticks` passed since the observation before: more than one where
        some were missed, in which the robot is taken to have moved as it does now, for as long as a sample is no older
        than `stale`.
        """
        if self.robot.imu.kind == "none":  # taken to be upright, and not to turn: nothing else is known
            upright = np.broadcast_to([0.0, 0.0, _GRAVITY], (*self.shape, 3))
            observation = replace(observation, angular_velocity=np.zeros((*self.shape, 3)), specific_force=upright)
        ticks = min(ticks, self.robot.limits.stale)
        dt = self.robot.dt * ticks
        q = np.where(np.isfinite(observation.position), observation.position, self._position)
        dq = np.where(np.isfinite(observation.velocity), observation.velocity, self._velocity)
        if self._pending.any():
            self._start(observation, q)
        self._position, self._velocity = q, dq
        position, rotation, origins, axes = self._legs.forward(self._legs.pick(q))
        leaning = self._leaning(rotation, dt)
        rate = self._attitude.update(observation.angular_velocity, observation.specific_force, dq, leaning, ticks)
        up = up_vector(self._attitude.quaternion)

        leg_rate = self._legs.pick(dq)
        corners = position[..., None, :] + np.einsum("...ij,...kj->...ki", rotation, self._legs.corners)
        heights = np.einsum("...lki,...i->...lk", corners, up)
        lowest = heights.min(-1)
        share = np.exp(-(heights - lowest[..., None]) / _CORNER_SOFTNESS)
        share /= share.sum(-1, keepdims=True)
        point = np.einsum("...lk,...lki->...li", share, corners)
        linear, _ = self._legs.velocity(point, origins, axes, leg_rate)
        foot_velocity = -(linear + cross(rate[..., None, :], point))  # of the base, were this foot fixed
        ground = lowest.min(-1, keepdims=True)
        contact = np.exp(-(lowest - ground) / FOOT_SOFTNESS)
        contact /= contact.sum(-1, keepdims=True)

        to_heading = _heading_frame(up)
        foot_velocity = np.einsum("...ij,...lj->...li", to_heading, foot_velocity)
        self.leg_velocity = np.einsum("...l,...li->...i", contact, foot_velocity)
        force = self._force = np.where(np.isfinite(observation.specific_force), observation.specific_force, 0.0)
        for _ in range(ticks):  # the network sees so many ticks back
            self.features.push(up, rate, force, q, dq, applied, foot_velocity, contact)
        velocity = self.leg_velocity
        if self._odometry is not None:
            velocity = velocity + self._odometry(self.features.window())
        if self._fallen_yaw is not None:
            velocity = np.zeros_like(velocity)

        yaw = self._attitude.yaw - self._heading0
        self._displacement[..., :2] += turned(velocity[..., :2], yaw) * dt
        self._displacement[..., 2] = -ground[..., 0]  # of one that lies, its height if it stood
        return State(
            time_ns=observation.time_ns,
            orientation=headed(self._attitude.quaternion, -self._heading0),
            gravity=-up,
            yaw=yaw,
            angular_velocity=rate,
            velocity=velocity,
            displacement=self._displacement.copy(),
            position=q,
            joint_velocity=dq,
            contact=contact,
        )

    def _leaning(self, rotation: Array, dt: float) -> Array:
        """How fast the base turned in `dt` [s] over soles `(..., n_feet, 3, 3)` that stay flat, `(..., 3)` rad/s in the
        base frame.

        From angles, not from the servos' velocities: their resolution is coarser than the creep of a soft robot.
        """
        before = rotation if self._soles is None else self._soles
        before = np.where(self._seen[..., None, None, None], before, rotation)
        self._soles, self._seen = rotation, np.ones(self.shape, bool)
        turn = np.einsum("...lij,...lkj->...ik", rotation, before) / rotation.shape[-3]
        skew = 0.5 * (turn - np.swapaxes(turn, -1, -2))
        return -joined(skew[..., 2, 1], skew[..., 0, 2], skew[..., 1, 0]) / dt

    def _start(self, observation: Observation, q: Array) -> None:
        where = self._pending
        force = np.where(np.isfinite(observation.specific_force), observation.specific_force, 0.0)
        self._attitude.reset(where, force, self._bias)
        self._displacement = np.where(where[..., None], 0.0, self._displacement)
        self._heading0 = np.where(where, 0.0, self._heading0)
        self.features.reset(where)
        self._seen = self._seen & ~where
        self._fallen_yaw, self._attitude.learns = None, True
        self._pending = np.zeros(self.shape, bool)


def _heading_frame(up: Array) -> Array:
    """Rotation `(..., 3, 3)` from the base frame to the heading frame, given the upward vector."""
    forward = np.zeros_like(up)
    forward[..., 0] = 1.0
    forward = forward - up[..., :1] * up
    forward /= np.linalg.norm(forward, axis=-1, keepdims=True) + 1e-9
    return np.stack([forward, cross(up, forward), up], -2)

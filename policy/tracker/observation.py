"""What the tracker sees: the estimate, a short history of joints and commands, and the reference's next frames.

Never the velocity that is asked.
"""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import ReferenceFrames, State
from servoid.hw.geometry import up_vector
from servoid.hw.robot.description import Robot
from servoid.hw.robot.mirror import Mirror

AHEAD = np.array([0, 3, 8])  # ticks ahead that a tracker of the gait sees of it
FURTHER = np.array([0, 3, 8, 16])  # and one of any reference
RESIDUAL = 0.3  # rad of joint target for an action of one
_HISTORY = 4  # past ticks of joints and gyro
# Past commands before the last one: a command takes up to 40 ms to the motor, and what it does up to 12 ms back.
_COMMANDS = 3


class TrackerObservation:
    """Builds observations `(..., size)` float32; keeps the short history. `shape` are the leading dimensions.

    With `clips` they are those of a tracker of any reference, which may lie, turn over and hurry; else of the gait.
    """

    def __init__(self, robot: Robot, shape: tuple[int, ...] = (), *, clips: bool = False) -> None:
        self._home, self._walking, self.clips = robot.home, robot.walking, clips
        self.ahead = FURTHER if clips else AHEAD  # ticks that `frames` are to be asked for
        n = len(robot.joints)
        self._past = np.zeros((*shape, _HISTORY, n + 3))
        self._before = np.zeros((*shape, _COMMANDS, n))  # newest first
        self._fresh = np.ones(shape, bool)
        joints, feet = Mirror.joints(robot), Mirror.feet(robot)
        own = Mirror.join(
            Mirror.VECTOR, Mirror.ROTATION, Mirror.PLANAR, Mirror.SCALAR, feet, *[joints] * (3 + _COMMANDS),
            *[joints, Mirror.ROTATION] * _HISTORY,
        )  # fmt: skip
        self.mirror = Mirror.join(own, self._reference_mirror(joints, feet))
        self.size = len(self.mirror.index)

    def _reference_mirror(self, joints: Mirror, feet: Mirror) -> Mirror:
        """Of what `_reference` returns."""
        look = len(self.ahead)
        mirror = Mirror.join(
            *[joints] * look, *[Mirror.PLANAR] * look, *[Mirror.FLIPPED] * look, *[Mirror.SCALAR] * look,
            *[feet] * look,
        )  # fmt: skip
        return Mirror.join(mirror, *[Mirror.VECTOR] * look, joints) if self.clips else mirror

    def reset(self, where: Array | None = None) -> None:
        """Forget the history in the worlds `where` (default: all)."""
        self._fresh = np.ones_like(self._fresh) if where is None else self._fresh | where

    def base(self, frames: ReferenceFrames) -> Array:
        """Joint targets `(..., n_joints)` rad to which the network's output is added: what the reference asks for."""
        return frames.position[..., 0, :]

    def __call__(self, state: State, applied: Array, frames: ReferenceFrames) -> Array:
        """Observe, once a tick. `applied` `(..., n_joints)` rad is what was commanded last; `frames` are at `ahead`."""
        joints = state.position - self._home
        row = np.concatenate([joints, 0.25 * state.angular_velocity], -1)
        if self._fresh.any():
            self._past = np.where(self._fresh[..., None, None], row[..., None, :], self._past)
            self._before = np.where(self._fresh[..., None, None], applied[..., None, :], self._before)
            self._fresh = np.zeros_like(self._fresh)
        lead, m = state.yaw.shape, self._walking
        observation = np.concatenate(
            [
                state.gravity,
                0.25 * state.angular_velocity,
                state.velocity[..., :2] / m.forward,
                self._rise * (state.displacement[..., 2:] - m.height),
                state.contact,
                joints,
                0.1 * state.joint_velocity,
                applied - state.position,
                (self._before - self._home).reshape(*lead, -1),
                self._past.reshape(*lead, -1),
                *self._reference(state, frames),
            ],
            -1,
        ).astype(np.float32)
        self._past = np.concatenate([row[..., None, :], self._past[..., :-1, :]], -2)
        self._before = np.concatenate([applied[..., None, :], self._before[..., :-1, :]], -2)
        return observation

    @property
    def _rise(self) -> float:
        """Heights are seen from that of walking, and speeds as shares of the fastest [1/m]."""
        return 2.5 / self._walking.height

    def _reference(self, state: State, frames: ReferenceFrames) -> list[Array]:
        """What is seen of the reference, `(..., k)` each."""
        lead, m = state.yaw.shape, self._walking
        seen = [
            (frames.position - self._home).reshape(*lead, -1),
            frames.velocity.reshape(*lead, -1) / m.forward,
            frames.yaw_rate,
            self._rise * (frames.height - m.height),
            frames.contact.reshape(*lead, -1),
        ]
        if self.clips:
            seen.append(-up_vector(frames.root_orientation).reshape(*lead, -1))
            seen.append(0.1 * frames.joint_velocity[..., 0, :])
        return seen

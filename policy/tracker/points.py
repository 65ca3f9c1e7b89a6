"""What a tracker of key points alone sees of its reference, as in CLoSD: where points of the body shall be and how fast
they shall move, in the robot's heading frame. No joint of the reference, and no velocity that is asked.

Z. Luo et al., "Perpetual Humanoid Control for Real-time Simulated Avatars" (2023), is where CLoSD's tracker comes from.
"""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import ReferenceFrames, State
from servoid.hw.geometry import cross, rotation_matrix
from servoid.hw.robot.description import Robot
from servoid.hw.robot.mirror import Mirror
from servoid.policy.diffusion.prefix.key_points import KeyPoints
from servoid.policy.tracker.observation import TrackerObservation

# Ticks ahead: the frames that a tracker of any reference sees, and the one after the first, for its velocity.
_POSITIONS, _AFTER = (0, 2, 3, 4), 1
_AHEAD = np.array([0, 1, 3, 8, 16])


class PointObservation(TrackerObservation):
    """Key points: the base, the ends of limbs, their first and middle joints, and the toes.

    Its own ones come from the estimate, by forward kinematics, and those of the reference from its poses. The network's
    output is added to the pose in which the robot stands, so that a reference's joints do not reach the servos either.
    """

    def __init__(self, robot: Robot, shape: tuple[int, ...] = ()) -> None:
        self._points = KeyPoints(robot, whole=True)
        self._dt, self._speed = robot.dt, 0.3 / robot.walking.forward
        super().__init__(robot, shape, clips=True)
        self.ahead = _AHEAD

    def _reference_mirror(self, joints: Mirror, feet: Mirror) -> Mirror:
        points = Mirror.join(Mirror.VECTOR, self._points.mirror())
        return Mirror.join(*[points] * (3 + len(_POSITIONS)))

    def base(self, frames: ReferenceFrames) -> Array:
        return np.broadcast_to(self._home, frames.position[..., 0, :].shape)

    def _reference(self, state: State, frames: ReferenceFrames) -> list[Array]:
        """Own places and velocities, by how much the reference's places differ, and its velocity from the own one."""
        upright = _upright(state.gravity)
        local = self._local(state.position)
        arms = np.einsum("...ij,...pj->...pi", upright, local)
        place = arms.copy()
        place[..., 2] += state.displacement[..., 2, None]
        further = self._local(state.position + self._dt * state.joint_velocity)
        moving = np.einsum("...ij,...pj->...pi", upright, (further - local) / self._dt)
        spin = np.einsum("...ij,...j->...i", upright, state.angular_velocity)
        velocity = state.velocity[..., None, :] + cross(np.broadcast_to(spin[..., None, :], arms.shape), arms) + moving
        asked = frames.root_position[..., None, :] + np.einsum(
            "...ij,...pj->...pi", rotation_matrix(frames.root_orientation), self._local(frames.position)
        )
        speed = (asked[..., _AFTER, :, :] - asked[..., 0, :, :]) / self._dt
        seen = [
            self._rise * place,
            self._speed * velocity,
            *(self._rise * (asked[..., k, :, :] - place) for k in _POSITIONS),
            self._speed * (speed - velocity),
        ]
        return [each.reshape(*each.shape[:-2], -1) for each in seen]

    def _local(self, joints: Array) -> Array:
        """Places `(..., points, 3)` m in the base frame; the base is the first."""
        points = self._points(joints)
        return np.concatenate([np.zeros_like(points[..., :1, :]), points], -2)


def _upright(gravity: Array) -> Array:
    """The turn `(..., 3, 3)` from the base frame to the heading frame, by gravity `(..., 3)`.

    Its x axis is that of the base along the ground; a base that points straight up has none, and any does.
    """
    up = -gravity
    x = np.zeros_like(up)
    x[..., 0] = 1.0
    forward = x - up[..., :1] * up
    forward = forward / np.maximum(np.linalg.norm(forward, axis=-1, keepdims=True), 1e-6)
    return np.stack([forward, cross(up, forward), up], -2)

"""Reward terms of the tracker: pure functions of one step, `(n,)` each."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Walking


@dataclass(frozen=True, slots=True)
class Step:
    """One tick of `n` worlds, by the truth. Reference values are those of the frame that was to be reached."""

    velocity: Array  # (n, 2) m/s of the base, heading frame, averaged over a gait cycle
    yaw_rate: Array  # (n,) rad/s, averaged likewise
    height: Array  # (n,) m
    gravity: Array  # (n, 3)
    angular_velocity: Array  # (n, 3)
    joints: Array  # (n, n_joints) rad
    effort: Array  # (n, n_joints) N m
    target: Array  # (n, n_joints) rad: the last three targets, newest first
    target1: Array
    target2: Array
    foot_force: Array  # (n, n_feet) N
    foot_height: Array  # (n, n_feet) m of the sole's centre
    foot_velocity: Array  # (n, n_feet, 3) m/s
    foot_up: Array  # (n, n_feet, 3)
    reference_velocity: Array  # (n, 2) averaged like the measured one, as is the yaw rate
    reference_yaw_rate: Array  # (n,)
    reference_height: Array  # (n,)
    reference_joints: Array  # (n, n_joints)
    reference_contact: Array  # (n, n_feet)
    reference_gravity: Array  # (n, 3) base frame of the reference
    residual: Array  # (n, n_joints) rad: what the tracker added to the reference, the last three, newest first
    residual1: Array
    residual2: Array
    fallen: Array  # (n,)
    walking: Walking  # of the robot: what is far, fast and high depends on its size
    weight: float  # N


def _kernel(squared: Array, width: float) -> Array:
    return np.exp(-squared / width**2)


def _near(squared: Array, wide: float, narrow: float) -> Array:
    """A wide kernel to find the way and a narrow one to hold it, of squared errors."""
    return 0.5 * _kernel(squared, wide) + 0.5 * _kernel(squared, narrow)


def _carries(s: Step) -> Array:
    """Whether a foot bears more than a thirtieth of the weight `(n, n_feet)`."""
    return s.foot_force > s.weight / 30.0


def velocity(s: Step) -> Array:
    """Planar velocity near the reference's."""
    error = ((s.velocity - s.reference_velocity) ** 2).sum(-1)
    return _near(error, 0.3 * s.walking.forward, 0.1 * s.walking.forward)


def progress(s: Step) -> Array:
    """Share of the reference's speed that is reached along its direction: it pulls where `velocity` is flat."""
    squared = (s.reference_velocity**2).sum(-1)
    along = (s.velocity * s.reference_velocity).sum(-1) / np.maximum(squared, 1e-6)
    return np.where(squared > (0.06 * s.walking.forward) ** 2, np.clip(along, 0.0, 1.0), 1.0)


def yaw_rate(s: Step) -> Array:
    """Yaw rate near the reference's."""
    error = (s.yaw_rate - s.reference_yaw_rate) ** 2
    return _near(error, 0.6 * s.walking.turning, 0.2 * s.walking.turning)


def turning(s: Step) -> Array:
    """Share of the reference's yaw rate that is reached: it pulls where `yaw_rate` is flat."""
    asked = s.reference_yaw_rate
    turns = np.abs(asked) > 0.06 * s.walking.turning
    return np.where(turns, np.clip(s.yaw_rate / np.where(turns, asked, 1.0), 0.0, 1.0), 1.0)


def pose(s: Step) -> Array:
    """Joints near the reference's."""
    return _kernel(((s.joints - s.reference_joints) ** 2).mean(-1), 0.25)


def joints(s: Step) -> Array:
    """Joints near the reference's: closer than `pose` asks for."""
    return _near(((s.joints - s.reference_joints) ** 2).mean(-1), 0.3, 0.12)


def orientation(s: Step) -> Array:
    """Gravity near the reference's, seen from the base: tilted as it, lying as it."""
    return _near(((s.gravity - s.reference_gravity) ** 2).sum(-1), 0.6, 0.2)


def base_height(s: Step) -> Array:
    """Base as high as the reference's, to a fifth of the height of walking."""
    return _kernel((s.height - s.reference_height) ** 2, 0.2 * s.walking.height)


def travel(s: Step) -> Array:
    """Velocity and yaw rate near the reference's, while that is upright: a heading says little of who lies."""
    upright = s.reference_gravity[:, 2] < -0.8
    return np.where(upright, 0.5 * velocity(s) + 0.5 * yaw_rate(s), 0.0)


def contact(s: Step) -> Array:
    """Share of feet that carry, or do not, as the reference plans."""
    return (_carries(s) == (s.reference_contact > 0.5)).mean(-1)


def clearance(s: Step) -> Array:
    """How far swinging feet are lifted, up to 8 % of the base's height."""
    swing = s.reference_contact < 0.5
    return (np.clip(s.foot_height / (0.08 * s.walking.height), 0.0, 1.0) * swing).sum(-1)


def upright(s: Step) -> Array:
    """Squared sine of the tilt."""
    return (s.gravity[:, :2] ** 2).sum(-1)


def height(s: Step) -> Array:
    """Squared error of the base's height [m2]."""
    return (s.height - s.reference_height) ** 2


def sway_rate(s: Step) -> Array:
    """Squared roll and pitch rate [rad2/s2]."""
    return (s.angular_velocity[:, :2] ** 2).sum(-1)


def slip(s: Step) -> Array:
    """Squared speed of feet that carry [m2/s2]."""
    return ((s.foot_velocity[..., :2] ** 2).sum(-1) * _carries(s)).sum(-1)


def level_feet(s: Step) -> Array:
    """Squared sine of the soles' tilt."""
    return (s.foot_up[..., :2] ** 2).sum((-1, -2))


def impact(s: Step) -> Array:
    """Force of a foot beyond twice the robot's weight, in units of that [1]."""
    return np.clip(s.foot_force / (2.0 * s.weight) - 1.0, 0.0, 2.0).sum(-1)


def target_rate(s: Step) -> Array:
    """Squared change of the targets [rad2]."""
    return ((s.target - s.target1) ** 2).sum(-1)


def target_acceleration(s: Step) -> Array:
    """Squared second difference of the targets [rad2]."""
    return ((s.target - 2 * s.target1 + s.target2) ** 2).sum(-1)


def residual(s: Step) -> Array:
    """Squared residual [rad2]."""
    return (s.residual**2).sum(-1)


def residual_rate(s: Step) -> Array:
    """Squared change of the residual [rad2]: of a clip's targets, which hurry by themselves, the part not asked for."""
    return ((s.residual - s.residual1) ** 2).sum(-1)


def residual_acceleration(s: Step) -> Array:
    """Squared second difference of the residual [rad2]."""
    return ((s.residual - 2 * s.residual1 + s.residual2) ** 2).sum(-1)


def effort(s: Step) -> Array:
    """Squared torque [N2 m2]."""
    return (s.effort**2).sum(-1)


def fall(s: Step) -> Array:
    """One on falling."""
    return s.fallen.astype(float)


TERMS: Mapping[str, Callable[[Step], Array]] = {
    term.__name__: term
    for term in (
        velocity, progress, yaw_rate, turning, pose, joints, orientation, base_height, travel, contact, clearance,
        upright, height, sway_rate, slip, level_feet, impact, target_rate, target_acceleration, residual, residual_rate,
        residual_acceleration, effort, fall,
    )
}  # fmt: skip

"""Carry the last valid sample over reads that failed, with its age growing."""

from __future__ import annotations

from dataclasses import replace
from typing import Any

import numpy as np

from servoid.hw.contracts.body import Observation

JOINT_FIELDS = ("position", "velocity", "effort")
IMU_FIELDS = ("angular_velocity", "specific_force")
SLOW_FIELDS = ("temperature", "voltage")  # read in rotation: their last value stands


class SampleHold:
    """Fills what an observation lacks (NaN) from the newest valid sample.

    A joint's sample is its position and velocity; the IMU's is angular velocity and specific force (not every IMU
    fuses them into an orientation). A filled sample keeps its own time, so its age says how old it is; the guard damps
    when it is too old. What was never read stays NaN with an infinite age.
    """

    def __init__(self) -> None:
        self._last: Observation | None = None

    def update(self, observation: Observation) -> Observation:
        """The observation with gaps filled. Takes and returns one body, `(n_joints,)` arrays."""
        joints = np.isfinite(observation.position) & np.isfinite(observation.velocity)
        imu = imu_valid(observation)
        last = self._last
        if last is None:
            filled = replace(
                observation,
                age=np.where(joints, observation.age, np.inf),
                imu_age=np.asarray(observation.imu_age if imu else np.inf),
            )
        else:
            passed = (observation.time_ns - last.time_ns) * 1e-9
            changes: dict[str, Any] = {
                name: np.where(joints, getattr(observation, name), getattr(last, name)) for name in JOINT_FIELDS
            }
            for name in SLOW_FIELDS:
                now = getattr(observation, name)
                changes[name] = np.where(np.isfinite(now), now, getattr(last, name))
            if not imu:
                changes |= {name: getattr(last, name) for name in (*IMU_FIELDS, "orientation")}
            changes["age"] = np.where(joints, observation.age, last.age + passed)
            changes["imu_age"] = np.asarray(observation.imu_age if imu else last.imu_age + passed)
            filled = replace(observation, **changes)
        self._last = filled
        return filled


def imu_valid(observation: Observation) -> bool:
    """Whether there is a sample of the IMU, or the robot has none: its age is NaN then."""
    return bool(
        np.isnan(observation.imu_age).all() or all(np.isfinite(getattr(observation, name)).all() for name in IMU_FIELDS)
    )


def complete(observation: Observation) -> bool:
    """Whether every joint and the IMU have a valid sample, however old."""
    return bool(
        np.isfinite(observation.position).all() and np.isfinite(observation.velocity).all() and imu_valid(observation)
    )


def missing(observation: Observation, names: tuple[str, ...]) -> list[str]:
    """Names of the joints, and `IMU`, that have no valid sample."""
    joints = np.isfinite(observation.position) & np.isfinite(observation.velocity)
    return [name for name, valid in zip(names, joints, strict=True) if not valid] + (
        [] if imu_valid(observation) else ["IMU"]
    )

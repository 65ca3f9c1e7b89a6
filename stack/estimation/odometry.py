"""The learned part of odometry: a small network that corrects the legs' velocity from the recent past."""

from __future__ import annotations

from pathlib import Path

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.policy.checkpoint import CHECKPOINTS, read_header, resolve
from servoid.policy.mlp import Mlp

# Ticks back that the network sees: dense lately, then a whole cycle of steps.
OFFSETS = np.array([0, 1, 2, 3, 4, 6, 8, 10, 12, 15, 18, 21, 24])


class OdometryFeatures:
    """The ring of recent features, `(..., ticks, features)` float32, newest first."""

    def __init__(self, robot: Robot, shape: tuple[int, ...] = ()) -> None:
        self._legs = robot.leg_index.ravel()
        feet = len(robot.feet)
        self.size = 9 + 3 * len(self._legs) + 3 * feet + feet
        self._ring = np.zeros((*shape, int(OFFSETS[-1]) + 1, self.size), np.float32)
        self._fresh = np.ones(shape, bool)

    def reset(self, where: Array) -> None:
        """The worlds `where` start with their first row repeated."""
        self._fresh = self._fresh | where

    def push(
        self, up: Array, rate: Array, force: Array, q: Array, dq: Array, applied: Array, foot: Array, contact: Array
    ) -> None:
        """Add a tick. Rates are scaled to be of the order of one."""
        legs = self._legs
        row = np.concatenate(
            [
                up,
                0.5 * rate,
                0.1 * force,
                q[..., legs],
                0.2 * dq[..., legs],
                4.0 * (applied - q)[..., legs],
                2.0 * foot.reshape(*foot.shape[:-2], -1),
                contact,
            ],
            -1,
        ).astype(np.float32)
        self._ring[..., 1:, :] = self._ring[..., :-1, :].copy()
        self._ring[..., 0, :] = row
        if self._fresh.any():
            self._ring[:] = np.where(self._fresh[..., None, None], row[..., None, :], self._ring)
            self._fresh = np.zeros_like(self._fresh)

    @property
    def newest(self) -> Array:
        """The last tick's row `(..., features)`."""
        return self._ring[..., 0, :]

    def window(self) -> Array:
        """What the network sees `(..., len(OFFSETS) * features)`."""
        picked = self._ring[..., OFFSETS, :]
        return picked.reshape(*picked.shape[:-2], -1)


def load_odometry(robot: Robot, name: str | Path = "odometry") -> Mlp:
    """The correction `(..., 3)` m/s of the base velocity, heading frame: the robot's own, else the shipped one, or of a
    file.

    Raises CheckpointError.
    """
    inputs = len(OFFSETS) * OdometryFeatures(robot).size
    return Mlp.load(resolve(name, robot), "odometry", robot, inputs)[0]


def odometry_of(robot: Robot) -> tuple[Mlp | None, str | None]:
    """The correction of a robot, or None where it has none that was trained for its joints, and what a person should
    know then. Raises CheckpointError for one of its own that cannot be used."""
    path = resolve("odometry", robot)
    if path.parent == CHECKPOINTS and list(read_header(path)["joints"]) != list(robot.names):
        return None, (
            f"odometry goes by the legs alone: {robot.name} has none in {robot.folder} yet "
            "(servoid train odometry --policy gait), so distances are only rough"
        )
    return load_odometry(robot), None

"""What a task policy sees: the estimate, a short history of it, and its goal. No reference, no phase, no truth."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import State
from servoid.hw.robot.description import Robot
from servoid.hw.robot.mirror import Mirror
from servoid.policy.features import raw_layout, raw_row
from servoid.policy.priors.goals import SeenGoal

_PAST = 4  # decisions before this one whose joints and turning rates are seen


class TaskObservation:
    """Builds observations `(..., size)` float32, once a decision, and keeps the short history. `shape` leads."""

    def __init__(self, robot: Robot, goal: SeenGoal, shape: tuple[int, ...] = ()) -> None:
        self._home, self._walking, n = robot.home, robot.walking, len(robot.joints)
        self._layout = raw_layout(n)
        self._past = np.zeros((*shape, _PAST, n + 3))
        self._fresh = np.ones(shape, bool)
        joints = Mirror.joints(robot)
        self._odometry = goal.odometry
        odometry = (Mirror.PLANAR, Mirror.SCALAR) if goal.odometry else ()
        self.mirror = Mirror.join(
            Mirror.VECTOR, Mirror.ROTATION, *odometry, joints, joints, joints,
            *[joints, Mirror.ROTATION] * _PAST, goal.mirror,
        )  # fmt: skip
        self.size = len(self.mirror.index)

    @property
    def joint_inputs(self) -> Array:
        """Where the joints are in an observation, now and in the past `(1 + past, n_joints)` int."""
        n = len(self._home)
        first = 6 + (3 if self._odometry else 0)
        past = first + 3 * n + np.arange(_PAST) * (n + 3)
        return np.r_[first, past][:, None] + np.arange(n)

    def reset(self, where: Array | None = None) -> None:
        """Forget the history in the worlds `where` (default: all)."""
        self._fresh = np.ones_like(self._fresh) if where is None else self._fresh | where

    def __call__(self, state: State, applied: Array, goal: Array, due: Array | None = None) -> Array:
        """Observe; `applied` `(..., n_joints)` rad is what was commanded last, `goal` what `SeenGoal.observe` gives.

        Worlds that decide now are `due` (default: all); the others' history stays, and what is seen of them means
        nothing.
        """
        return self.of_rows(raw_row(state), applied, goal, due)

    def of_rows(self, raw: Array, applied: Array, goal: Array, due: Array | None = None) -> Array:
        """The same of raw rows `(..., raw size)`: those of a recording, say."""
        due = np.ones_like(self._fresh) if due is None else due
        row = self._layout.split(raw)
        joints = row["position"] - self._home
        now = np.concatenate([joints, 0.25 * row["angular_velocity"]], -1)
        first = self._fresh & due
        if first.any():
            self._past = np.where(first[..., None, None], now[..., None, :], self._past)
            self._fresh = self._fresh & ~due
        m = self._walking
        odometry = [row["velocity"][..., :2] / m.forward, 2.5 / m.height * (row["displacement"][..., 2:] - m.height)]
        parts = [
            row["gravity"],
            0.25 * row["angular_velocity"],
            *(odometry if self._odometry else []),
            joints,
            0.1 * row["joint_velocity"],
            applied - row["position"],
            self._past.reshape(*joints.shape[:-1], -1),
            goal,
        ]
        past = np.concatenate([now[..., None, :], self._past[..., :-1, :]], -2)
        self._past = np.where(due[..., None, None], past, self._past)
        return np.concatenate(parts, -1).astype(np.float32)

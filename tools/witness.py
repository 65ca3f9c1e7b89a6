"""Watches a simulated run by the truth, in the frame that the robot's odometry started in."""

from __future__ import annotations

import numpy as np

from hw.hal import Array, Trace, Truth
from stack.loop import TickRecord
from stack.session import TASK_STREAM


class Witness:
    """An `on_tick` listener: one row for each tick of the task."""

    def __init__(self, truth: Truth, dt: float) -> None:
        self._truth, self._dt = truth, dt
        self._rows: list[tuple[Array, float, Array, float, Array]] = []
        self._fallen = False

    def __call__(self, record: TickRecord) -> None:
        instruction, truth = record.proposal.instruction, self._truth
        if instruction is None:
            return
        self._fallen |= bool(truth.fallen[0])
        rate = -float(truth.gravity[0] @ truth.angular_velocity[0])
        self._rows.append(
            (truth.position[0].copy(), float(truth.yaw[0]), truth.velocity[0], rate, instruction.velocity)
        )

    @staticmethod
    def task_rng(seed: int) -> np.random.Generator:
        """The random stream that the session gave the task, to draw the same episode again."""
        return np.random.default_rng([seed, TASK_STREAM])

    def trace(self) -> Trace:
        """The run by the truth; without rows if the guard never let the task begin."""
        if not self._rows:
            none = np.zeros((0, 3))
            return Trace(self._dt, none, np.zeros(0), none, np.zeros(0), none, self._fallen)
        position, yaw, velocity, rate, command = (np.array(column) for column in zip(*self._rows, strict=True))
        yaw = np.unwrap(yaw)
        offset = position - position[0] * [1.0, 1.0, 0.0]
        c, s = np.cos(yaw[0]), np.sin(yaw[0])
        x, y = offset[:, 0], offset[:, 1]
        return Trace(
            dt=self._dt,
            displacement=np.stack([c * x + s * y, c * y - s * x, offset[:, 2]], -1),
            yaw=yaw - yaw[0],
            velocity=velocity,
            yaw_rate=rate,
            command=command,
            fallen=self._fallen,
        )

    def odometry_error(self, estimate: Trace) -> float:
        """Distance [m] between where the robot ended and where it believed to be; NaN if the task never began."""
        if not self._rows:
            return float("nan")
        end = self.trace().displacement[-1, :2]
        return float(np.linalg.norm(end - estimate.displacement[-1, :2]))

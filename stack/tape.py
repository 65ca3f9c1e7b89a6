"""What a run went through, kept as numbers: a row a tick, in memory that is taken before the run begins."""

from __future__ import annotations

import numpy as np

from hw.hal import Array, Instruction, Percept, State, Trace

_LONGEST = 36_000  # ticks that room is made for at once; a longer run takes as much again
_COLUMNS = {"displacement": 3, "yaw": 1, "velocity": 3, "yaw_rate": 1, "command": 3}  # and the joints


class Tape:
    """Rows of a task of one robot; `len` of it are the ticks so far."""

    def __init__(self, joints: int, ticks: int) -> None:
        """For about so many ticks. A page that was never written to takes no memory yet: hence the NaN."""
        self._joints = joints
        self._rows: Array = np.full((min(ticks, _LONGEST) + 1, sum(_COLUMNS.values()) + joints), np.nan)
        self._length = 0
        self._goals: list[Array | None] = []
        self._obstacles: list[Array | None] = []
        self._robots: list[Array | None] = []

    def __len__(self) -> int:
        return self._length

    def add(self, state: State, instruction: Instruction, percept: Percept) -> None:
        """Keep a tick."""
        if self._length == len(self._rows):
            self._rows = np.concatenate([self._rows, np.full_like(self._rows, np.nan)])
        about_vertical = -float(state.gravity @ state.angular_velocity)
        self._rows[self._length] = np.concatenate(
            [
                state.displacement,
                [float(state.yaw)],
                state.velocity,
                [about_vertical],
                instruction.velocity,
                state.position,
            ]
        )
        self._length += 1
        self._goals.append(percept.goal)
        self._obstacles.append(percept.obstacles)
        self._robots.append(percept.robots)

    def trace(self, dt: float, fallen: bool) -> Trace:
        """All of it, with ticks of `dt` s."""
        ends = np.cumsum(list(_COLUMNS.values()))
        *columns, joints = (part.copy() for part in np.split(self._rows[: self._length], ends, axis=1))
        part = dict(zip(_COLUMNS, columns, strict=True))
        return Trace(
            dt=dt,
            displacement=part["displacement"],
            yaw=part["yaw"][:, 0],
            velocity=part["velocity"],
            yaw_rate=part["yaw_rate"][:, 0],
            command=part["command"],
            fallen=fallen,
            joints=joints,
            goal=_stacked(self._goals),
            obstacles=_stacked(self._obstacles),
            robots=_stacked(self._robots),
        )


def _stacked(rows: list[Array | None]) -> Array | None:
    """Rows `(ticks, ...)` of what was perceived; None where there was nothing to perceive."""
    present = [row for row in rows if row is not None]
    return np.array(present) if present and len(present) == len(rows) else None

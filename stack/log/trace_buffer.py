"""What a run went through, kept as numbers: a row a tick, in memory that is taken before the run begins."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.task import Trace
from servoid.hw.contracts.world import Percept

_LONGEST = 36_000  # ticks that room is made for at once; a longer run takes as much again
_COLUMNS = {"displacement": 3, "yaw": 1, "velocity": 3, "yaw_rate": 1, "command": 3, "orientation": 4}  # and joints


class TraceBuffer:
    """Rows of a task of one robot; `len` of it are the ticks so far."""

    def __init__(self, joints: int, ticks: int) -> None:
        """For about so many ticks. A page that was never written to takes no memory yet: hence the NaN."""
        self._joints = joints
        self._rows: Array = np.full((min(ticks, _LONGEST) + 1, sum(_COLUMNS.values()) + joints), np.nan)
        self._length = 0
        # Where there was something.
        self._seen: dict[str, list[Array]] = {"goal": [], "obstacles": [], "robots": [], "objects": []}

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
                state.orientation,
                state.position,
            ]
        )
        self._length += 1
        for name, rows in self._seen.items():
            if (what := getattr(percept, name)) is not None:
                rows.append(what)

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
            orientation=part["orientation"],
            goal=self._stacked("goal"),
            obstacles=self._stacked("obstacles"),
            robots=self._stacked("robots"),
            objects=self._stacked("objects"),
        )

    def _stacked(self, name: str) -> Array | None:
        """Rows `(ticks, ...)` of what was perceived; None where at some tick nothing was."""
        rows = self._seen[name]
        return np.array(rows) if rows and len(rows) == self._length else None

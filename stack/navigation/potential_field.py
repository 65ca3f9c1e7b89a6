"""A potential field without traps: which way to walk to a goal past obstacles, for policies that follow a velocity."""

from __future__ import annotations

from dataclasses import dataclass
from typing import Annotated

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import DistanceMap, State
from servoid.hw.geometry import to_heading
from servoid.hw.setting import Setting, check

_CELL = 0.05 / 0.17  # of the robot's half width: cells of a grid that is not much finer than the robot
_ROOM = 0.5 / 0.17  # around everything
_WALL = 30.0  # times dearer is a cell that the robot does not fit into: no goal is ever out of reach
_NEIGHBOURS = [(i, j) for i in (-1, 0, 1) for j in (-1, 0, 1) if i or j]


@dataclass(frozen=True)
class FieldSettings:
    body: Annotated[float, Setting("distance from the middle of the robot to its side", "m", above=0, of="height")] = (
        0.17
    )
    strength: Annotated[float, Setting("how many times dearer a way beside an obstacle is", above=0)] = 4.0
    fade: Annotated[float, Setting("distance over which that falls to 1/e", "m", above=0, of="height")] = 0.08
    step: Annotated[float, Setting("how far the robot looks down the field", "m", above=0, of="height")] = 0.2

    def __post_init__(self) -> None:
        check(self)


class PotentialField:
    """The cost of the cheapest way to `goal` `(2,)` m from each cell of a grid, among `obstacles` `(n, 3)` m.

    A metre costs `1 + strength exp(-(d - body) / fade)`, d being the distance from the nearest obstacle. The grid
    covers obstacles, goal and `place` `(2,)`, all in one frame.
    """

    def __init__(self, goal: Array, obstacles: Array, place: Array, settings: FieldSettings) -> None:
        self.goal, self.obstacles, self._settings = goal.copy(), obstacles.copy(), settings
        self._size, room = settings.body * _CELL, settings.body * _ROOM
        points = np.vstack([obstacles[:, :2], goal, place])
        self._low = points.min(0) - room
        shape = np.ceil((points.max(0) + room - self._low) / self._size).astype(int) + 1
        self._last = shape - 1
        x, y = (self._low[axis] + self._size * np.arange(shape[axis]) for axis in (0, 1))
        cells = np.stack(np.meshgrid(x, y, indexing="ij"), axis=-1)
        apart = np.linalg.norm(cells[..., None, :] - obstacles[:, :2], axis=-1) - obstacles[:, 2]
        free = apart.min(-1, initial=np.inf) - settings.body
        price = np.where(free < 0.0, _WALL, 1.0 + settings.strength * np.exp(-np.maximum(free, 0.0) / settings.fade))
        self._potential = _spread(price, self._size, self._cell(goal))

    def fits(self, goal: Array, obstacles: Array, place: Array) -> bool:
        """Whether this is still the field, to a cell, and covers `place`."""
        if obstacles.shape != self.obstacles.shape or not self._covers(place):
            return False
        moved = np.vstack([obstacles[:, :2] - self.obstacles[:, :2], goal - self.goal])
        return bool(np.abs(moved).max() < self._size)

    def downhill(self, place: Array) -> Array:
        """The point `(2,)` m that lies `step` m down the field from `place`, or the goal."""
        i, j = self._cell(place)
        for _ in range(max(round(self._settings.step / self._size), 1)):
            around = [(i + di, j + dj) for di, dj in _NEIGHBOURS]
            inside = [cell for cell in around if 0 <= cell[0] <= self._last[0] and 0 <= cell[1] <= self._last[1]]
            best = min(inside, key=lambda cell: float(self._potential[cell]))
            if self._potential[best] >= self._potential[i, j]:
                return self.goal.copy()
            i, j = best
        return self._low + self._size * np.array([i, j])

    def seen_from(self, state: State) -> DistanceMap:
        """The potential in the heading frame of `state`."""
        return DistanceMap(to_heading(self._low, state), -float(state.yaw), self._size, self._potential)

    def _covers(self, place: Array) -> bool:
        cell = (place - self._low) / self._size
        return bool((cell > 0.0).all() and (cell < self._last).all())

    def _cell(self, place: Array) -> tuple[int, int]:
        """The nearest cell of the grid."""
        i, j = np.clip(np.round((place - self._low) / self._size).astype(int), 0, self._last)
        return int(i), int(j)


def _spread(price: Array, size: float, goal: tuple[int, int]) -> Array:
    """Cost of the cheapest way to the cell `goal` from each cell, through the 8 neighbours of each."""
    cost = np.full((price.shape[0] + 2, price.shape[1] + 2), np.inf)
    inner = cost[1:-1, 1:-1]
    inner[goal] = 0.0
    while True:
        before = inner.copy()
        for i, j in _NEIGHBOURS:
            reached = cost[1 + i : 1 + i + price.shape[0], 1 + j : 1 + j + price.shape[1]]
            np.minimum(inner, reached + size * np.hypot(i, j) * price, out=inner)
        if np.array_equal(before, inner):
            return inner.copy()

"""What can be dragged in the picture."""

from __future__ import annotations

import time
from collections.abc import Callable, Mapping
from typing import Any

import numpy as np

from servoid.hw.contracts.body import Array

SIZE = 0.09  # m
HELD_SECONDS = 0.5  # since it was moved last, for which a handle is somebody's, and is not put anywhere else
OFTEN_SECONDS = 0.06  # between two that are told


class Handles:
    """Arrows below the node `root` of a viser server. `dragged` is told a name and a place `(3,)` m, in a thread of
    viser's own."""

    def __init__(self, server: Any, root: str, dragged: Callable[[str, Array], None]) -> None:
        self._server, self._root, self._dragged = server, root, dragged
        self._made: dict[str, Any] = {}
        self._moved: dict[str, float] = {}  # s, when somebody moved each last
        self._told = 0.0

    def show(self, places: Mapping[str, Array]) -> None:
        """Put handles at `places` `(3,)` m, and take all others away."""
        for name in self._made.keys() - places.keys():
            self._made.pop(name).remove()
        for name, place in places.items():
            if name not in self._made:
                self._make(name)
            if time.monotonic() - self._moved.get(name, 0.0) > HELD_SECONDS:
                self._made[name].position = tuple(place)

    def _make(self, name: str) -> None:
        handle = self._server.scene.add_transform_controls(
            f"{self._root}/handle {name}", SIZE, disable_rotations=True, depth_test=False, opacity=0.7
        )

        def moved(_: Any) -> None:
            now = self._moved[name] = time.monotonic()
            if now - self._told > OFTEN_SECONDS:
                self.tell(name, handle.position)

        handle.on_update(moved)
        handle.on_drag_end(lambda _: self.tell(name, handle.position))
        self._made[name] = handle

    def tell(self, name: str, position: Any) -> None:
        self._told = time.monotonic()
        self._dragged(name, np.array(position, dtype=float))

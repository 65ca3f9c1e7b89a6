"""Several robots in one MuJoCo world: how they get into its model, and how each is a row of its own again.

The first robot keeps its names and comes first; the names of the others begin with `prefix`. All are alike, so that
what belongs to a robot is a block of the same length in the world's arrays, and what is known of the first by name
holds for the others by its place in the block.
"""

from __future__ import annotations

from collections.abc import Mapping
from typing import Any

import mujoco
import numpy as np
from mujoco.batch import Batch

from servoid.hw.contracts.body import Array

ADDED = "servoid/"  # what all names begin with that are added to those of a robot's own file
_BIT = 8  # the first of the collision bits that tell robots apart; a robot's own file uses those below


def prefix(number: int) -> str:
    """What the names of a robot begin with; the first one, number 0, has its own names."""
    return f"robot{number}/" if number else ""


def tell_apart(model: mujoco.MjSpec, base: str, robots: int) -> None:
    """Let whatever of one robot can be touched touch whatever of another can; their bases are named `base`."""
    everyone = sum(1 << (_BIT + number) for number in range(robots))
    for number in range(robots):
        own = 1 << (_BIT + number)
        for geom in model.body(prefix(number) + base).find_all(mujoco.mjtObj.mjOBJ_GEOM):
            if geom.contype or geom.conaffinity:
                geom.contype |= own
                geom.conaffinity |= everyone & ~own


class Crowd:
    """One world of `n` robots that is reset, stepped and read like a `mujoco.batch.Batch` of `n` worlds of one."""

    def __init__(self, model: mujoco.MjModel, n: int) -> None:
        """Raises ValueError for a model that is not made of `n` robots alike."""
        if any(size % n for size in (model.nq, model.nv, model.nu, model.nsensordata, model.nbody - 1)):
            raise ValueError(f"not a world of {n} robots and nothing else that moves or is felt")
        self._batch, self._n = Batch(model, 1, 1), n
        self._bodies = (model.nbody - 1) // n  # of a robot; the world's own comes before all
        self._out: dict[str, Array] = {}

    def bind(self, name: str) -> Array:
        """A live view `(n, ...)` of a field of the world's data."""
        return _rows(self._batch.bind(name), self._n)

    def expand(self, name: str) -> Array:
        """A live view `(n, ...)` of a field of the model.

        Of bodies by the first robot's numbers, from 1 on; what is of geoms is shared by all rows.
        """
        field = self._batch.expand(name)
        if name.startswith(("actuator_", "dof_")):
            return _rows(field, self._n)
        step = self._bodies if name.startswith("body_") else 0
        length = self._bodies + 1 if step else field.shape[1]
        return np.lib.stride_tricks.as_strided(
            field, (self._n, length, *field.shape[2:]), (step * field.strides[1], *field.strides[1:])
        )

    def reset(self, ids: Array, **options: Any) -> None:
        """Raises ValueError unless it is for all: who shares a world begins together."""
        if len(ids) != self._n:
            raise ValueError(f"{self._n} robots share a world: reset all of them, not {len(ids)}")
        self._batch.reset([0], **options)

    def set_const(self, ids: Array) -> None:
        self._batch.set_const([0])

    def forward(self, ids: Array) -> None:
        self._batch.forward([0])

    def rollout(self, substeps: int, control: Array, *, record: tuple[str, ...], out: Mapping[str, Array]) -> None:
        """Step under `control` `(n, substeps, nu)`, and fill `out` with what is recorded: `(n, substeps, ...)`."""
        if not self._out:
            self._out = {key: np.zeros((1, substeps, self._n * out[key].shape[-1])) for key in record}
        together = np.ascontiguousarray(control.swapaxes(0, 1)).reshape(1, substeps, -1)
        self._batch.rollout(substeps, together, record=record, out=self._out)
        for key in record:
            out[key][:] = self._out[key].reshape(substeps, self._n, -1).swapaxes(0, 1)


def _rows(field: Array, n: int) -> Array:
    """`(1, n k, ...)` as `(n, k, ...)`, without a copy."""
    view = field[0].reshape(n, field.shape[1] // n, *field.shape[2:])
    assert np.shares_memory(view, field)
    return view

"""What all sources of human motion give: places of points of a body, and when its feet stand."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass
from pathlib import Path

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array

SIDES = ("left", "right")
POINTS = ("hips", "neck", *(f"{side}_{part}" for side in SIDES for part in
          ("hip", "knee", "ankle", "toe", "shoulder", "elbow", "hand")))  # fmt: skip
# In lengths of the leg, and for speeds of those a second. A foot in a walk passes at about five.
_LOW = 0.08  # above its lowest place
_SLOW = 0.45
_SHORTEST = 0.08  # s: what is shorter is noise, standing or not


@dataclass(frozen=True)
class CapturedMotion:
    """A motion as places of `POINTS`, each `(ticks, 3)`, z up, in a unit of the file's own; x and y as they come."""

    rate: float  # ticks a second
    points: Mapping[str, Array]

    @property
    def leg(self) -> float:
        """Length of a leg, from hip to ankle."""
        p = self.points
        thigh, shank = (
            np.linalg.norm(p[f"left_{a}"] - p[f"left_{b}"], axis=-1) for a, b in (("hip", "knee"), ("knee", "ankle"))
        )
        return float(np.median(thigh) + np.median(shank))

    @property
    def ticks(self) -> int:
        return len(self.points["hips"])

    def cut(self, first: int, last: int) -> CapturedMotion:
        return CapturedMotion(self.rate, {name: at[first:last] for name, at in self.points.items()})

    def stands(self) -> Array:
        """When each foot is flat on the ground `(ticks, 2)` bool: heel and toes low and slow.

        Between one that leaves by its toes and one that comes by its heel, both are flat until, and from, halfway.
        """
        still = self._still()
        flat = np.stack([_without_short(both[0] & both[1], round(_SHORTEST * self.rate)) for both in still], -1)
        for first, last in _runs(np.asarray(~flat.any(-1))):
            before = flat[first - 1] if first > 0 else flat[last] if last < self.ticks else True
            after = flat[last] if last < self.ticks else before
            half = (first + last) // 2
            flat[first:half] |= before
            flat[half:last] |= after
        return flat

    def flight(self) -> float:
        """The longest time without a foot on the ground, s."""
        heights = [self.points[f"{side}_{part}"][:, 2] / self.leg for side in SIDES for part in ("ankle", "toe")]
        away = np.min([h - np.percentile(h, 5) for h in heights], axis=0) > _LOW
        return max((last - first for first, last in _runs(away)), default=0) / self.rate

    def _still(self) -> list[Array]:
        """Of each foot, when its heel and its toes are low and slow `(2, ticks)` bool."""
        out = []
        for side in SIDES:
            parts = [self.points[f"{side}_{part}"] / self.leg for part in ("ankle", "toe")]
            speed = [np.linalg.norm(np.gradient(at, 1 / self.rate, axis=0), axis=-1) for at in parts]
            height = [at[:, 2] - np.percentile(at[:, 2], 5) for at in parts]
            out.append(np.logical_and(np.array(height) < _LOW, np.array(speed) < _SLOW))
        return out


def _runs(flags: Array) -> Array:
    """First and one past the last tick of each run `(n, 2)`."""
    return np.flatnonzero(np.diff(np.r_[False, flags, False].astype(int))).reshape(-1, 2)


def _without_short(flags: Array, ticks: int) -> Array:
    """Runs shorter than `ticks` turned over: gaps first."""
    for value in (False, True):
        for first, last in _runs(flags if value else ~flags):
            if last - first < ticks and first > 0 and last < len(flags):
                flags[first:last] = not value
    return flags


def read(path: Path) -> CapturedMotion:
    """A motion by the kind of its file: .bvh, or .txt and .json of DeepMimic. Raises ConfigError."""
    from servoid.tools.motions.human.bvh import read_bvh
    from servoid.tools.motions.human.deepmimic import read_deepmimic

    readers = {".bvh": read_bvh, ".txt": read_deepmimic, ".json": read_deepmimic}
    if path.suffix.lower() not in readers:
        raise ConfigError(f"{path}: not a human motion (.bvh, or .txt of DeepMimic)")
    try:
        text = path.read_text(errors="replace")
    except OSError as error:
        raise ConfigError(f"{path}: cannot be read ({error.strerror})") from None
    return readers[path.suffix.lower()](path, text)

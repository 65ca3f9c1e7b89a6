"""What each tick of a recording was told, and for how long: sentences with a clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.policy.text.captions import MOTIONS, mirrored, motion_of

_SHORTEST, _LONGEST = 0.5, 20.0  # s, periods of a clock's waves


@dataclass(frozen=True)
class Told:
    """Labels of the rows of a recording; a label has phrasings, the first being canonical."""

    label: Array  # (rows,) int
    clock: Array  # (rows,) s since what is told began; 0 of a walk, which has no beginning
    phrasings: tuple[tuple[str, ...], ...]  # of each label: of `MOTIONS`, then of skills
    mirrored: Array  # (labels,) int, the label of its mirror image; -1: that is none of them

    @staticmethod
    def walks(command: Array, top: Array) -> Told:
        """Of commands `(rows, 3)` to a robot of top speeds `(3,)`."""
        phrasings = tuple(motion.phrasings for motion in MOTIONS)
        return Told(motion_of(command, top), np.zeros(len(command)), phrasings, mirrored(np.arange(len(MOTIONS))))

    @property
    def changes(self) -> Array:
        """Rows `(rows,)` bool at which something else is told, or the same anew."""
        return np.r_[True, (np.diff(self.label) != 0) | (np.diff(self.clock) < 0.0)]


def clock_code(seconds: Array, waves: int) -> Array:
    """Sines and cosines `(..., 2 waves)` float32 of times `(...)` s."""
    angles = 2.0 * np.pi * np.asarray(seconds)[..., None] / np.geomspace(_SHORTEST, _LONGEST, waves)
    return np.concatenate([np.sin(angles), np.cos(angles)], -1).astype(np.float32)

"""What each tick of a recording was told, and for how long: sentences with a clock."""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.policy.text.captions import MOTIONS, mirrored, motion_of

UNDER_WAY = 1.0  # s from being told a walk until it counts as under way
_SHORTEST, _LONGEST = 0.5, 20.0  # s, periods of a clock's waves


@dataclass(frozen=True)
class Told:
    """Labels of the rows of a recording; a label has phrasings, the first being canonical."""

    label: Array  # (rows,) int
    clock: Array  # (rows,) s since the skill began that is told; of a walk as `walk_clock` has it
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


def walk_clock(seconds: Array) -> Array:
    """The clock of a walk [s], so long after it was told: from `-UNDER_WAY` to 0, where it stays.

    A robot that stands begins to walk some ticks after it is told. Without a clock each new plan would put it off by as
    many ticks, for ever.
    """
    return np.minimum(np.asarray(seconds) - UNDER_WAY, 0.0)


def clock_code(seconds: Array, waves: int) -> Array:
    """Sines and cosines `(..., 2 waves)` float32 of times `(...)` s."""
    angles = 2.0 * np.pi * np.asarray(seconds)[..., None] / np.geomspace(_SHORTEST, _LONGEST, waves)
    return np.concatenate([np.sin(angles), np.cos(angles)], -1).astype(np.float32)

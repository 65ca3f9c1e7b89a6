"""Which of some motions the joints of a robot went through: what it is judged by whether it did what it was told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
from numpy.lib.stride_tricks import sliding_window_view

from servoid.hw.contracts.body import Array

LATEST_SECONDS = 2.6  # from being told to beginning: to end what may not be left, to rise, to come to a stand
SHOWN_SECONDS = 1.4  # of a motion, or all of a shorter one, that must be seen
ALIKE = 0.15  # rad, root mean square over joints and time, up to which a motion is the one that was told
STILL = "stand"
_STEP = 2  # ticks between the shifts that are tried


@dataclass(frozen=True)
class SeenMotion:
    """A motion to be told apart from others: its joints `(ticks, n_joints)` rad, and those that it comes to rest in."""

    joints: Array
    after: Array


def misfit(joints: Array, motion: SeenMotion, dt: float) -> tuple[float, float]:
    """How far joints `(ticks, n_joints)` rad are off a motion that begins somewhere in them: root mean squares over all
    ticks, its first pose held before it and its rest after it, and over the motion alone; where the first is least.

    Infinite where there are too few ticks to see it.
    """
    ticks, (length, n) = len(joints), motion.joints.shape
    latest = min(round(LATEST_SECONDS / dt), ticks - min(length, round(SHOWN_SECONDS / dt)))
    if latest < 0:
        return np.inf, np.inf
    at = np.arange(0, latest + 1, _STEP)
    shown = np.minimum(length, ticks - at)
    before, after = (_sums((joints - pose) ** 2) for pose in (motion.joints[0], motion.after))
    # Sums of (j - m)^2, as those of j^2 and m^2, which are the same of all shifts, and of j m.
    padded = np.concatenate([joints, np.zeros((length, n))])
    product = np.einsum("akt,tk->a", sliding_window_view(padded, length, 0)[at], motion.joints)
    seen, meant = _sums(joints**2), _sums(motion.joints**2)
    during = np.maximum(seen[at + shown] - seen[at] + meant[shown] - 2.0 * product, 0.0)
    whole = before[at] + during + after[-1] - after[at + shown]
    best = int(whole.argmin())
    return float(np.sqrt(whole[best] / joints.size)), float(np.sqrt(during[best] / (shown[best] * n)))


def _sums(values: Array) -> Array:
    """Of the first 0, 1, ... rows: `(rows + 1,)`."""
    return np.concatenate([[0.0], np.cumsum(values.sum(-1))])


def nearest(joints: Array, motions: Mapping[str, SeenMotion], home: Array, dt: float) -> tuple[str, float]:
    """The motion that joints `(ticks, n_joints)` rad are least off, `STILL` where that is standing at `home`; and how
    far off they are while it lasts [rad]."""
    off = {name: misfit(joints, motion, dt) for name, motion in motions.items()}
    still = float(np.sqrt(np.mean((joints - home) ** 2)))
    name = min([STILL, *off], key=lambda name: still if name == STILL else off[name][0])
    return name, still if name == STILL else off[name][1]


def performed(asked: str, joints: Array, motions: Mapping[str, SeenMotion], home: Array, dt: float) -> bool:
    """Whether joints went through the motion that was `asked` for, rather than any other."""
    name, off = nearest(joints, motions, home, dt)
    return name == asked and off <= ALIKE

"""Which of some motions the joints of a robot went through: what it is judged by whether it did what it was told."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.body import Array

LATEST_SECONDS = 2.6  # from being told to beginning: to end what may not be left, to rise, to come to a stand
SHOWN_SECONDS = 1.4  # of a motion, or all of a shorter one, that must be seen
ALIKE = 0.15  # rad, root mean square over joints and time, up to which a motion is the one that was told
STILL = "stand"


@dataclass(frozen=True)
class Shown:
    """A motion to be told apart from others: its joints `(ticks, n_joints)` rad, and those that it comes to rest in."""

    joints: Array
    after: Array


def misfit(joints: Array, motion: Shown, dt: float) -> tuple[float, float]:
    """How far joints `(ticks, n_joints)` rad are off a motion that begins somewhere in them: root mean squares over all
    ticks, its first pose held before it and its rest after it, and over the motion alone; where the first is least.

    Infinite where there are too few ticks to see it.
    """
    ticks, length = len(joints), len(motion.joints)
    latest = min(round(LATEST_SECONDS / dt), ticks - min(length, round(SHOWN_SECONDS / dt)))
    best = np.inf, np.inf
    for at in range(0, latest + 1, 2):
        shown = min(length, ticks - at)
        before = (joints[:at] - motion.joints[0]) ** 2
        during = (joints[at : at + shown] - motion.joints[:shown]) ** 2
        after = (joints[at + shown :] - motion.after) ** 2
        whole = (before.sum() + during.sum() + after.sum()) / joints.size
        best = min(best, (float(np.sqrt(whole)), float(np.sqrt(during.mean()))))
    return best


def nearest(joints: Array, motions: Mapping[str, Shown], home: Array, dt: float) -> tuple[str, float]:
    """The motion that joints `(ticks, n_joints)` rad are least off, `STILL` where that is standing at `home`; and how
    far off they are while it lasts [rad]."""
    off = {name: misfit(joints, motion, dt) for name, motion in motions.items()}
    still = float(np.sqrt(np.mean((joints - home) ** 2)))
    name = min([STILL, *off], key=lambda name: still if name == STILL else off[name][0])
    return name, still if name == STILL else off[name][1]


def performed(asked: str, joints: Array, motions: Mapping[str, Shown], home: Array, dt: float) -> bool:
    """Whether joints went through the motion that was `asked` for, rather than any other."""
    name, off = nearest(joints, motions, home, dt)
    return name == asked and off <= ALIKE

"""Clips made by a formula, for tests that need a motion of which everything is known."""

from __future__ import annotations

import numpy as np

from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import About, Clip

ABOUT = About(captions=("wave the left hand",), source="a formula", licence="Apache-2.0")


def walking_in_a_circle(robot: Robot, ticks: int = 51, about: About = ABOUT, turn: float = 0.5) -> Clip:
    """The base goes along an arc of `turn` rad and 0.5 m while the joints swing about home by 0.1 rad."""
    share = np.linspace(0.0, 1.0, ticks)
    yaw = turn * share
    radius = 0.5 / turn if turn else 0.0
    x, y = (radius * np.sin(yaw), radius * (1 - np.cos(yaw))) if turn else (0.5 * share, np.zeros(ticks))
    zero = np.zeros(ticks)
    return Clip(
        "circle",
        robot.home + 0.1 * np.sin(2 * np.pi * share)[:, None],
        np.stack([x, y, np.full(ticks, 0.25)], -1),
        np.stack([np.cos(yaw / 2), zero, zero, np.sin(yaw / 2)], -1),
        np.ones((ticks, len(robot.feet))),
        about,
    )

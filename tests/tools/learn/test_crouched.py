"""Data of walks lower than upright."""

from __future__ import annotations

import numpy as np

from servoid.hw.robot.description import load_robot
from servoid.stack.control.fleet import Fleet
from servoid.stack.control.tracker import ExpertPolicy
from servoid.tools.learn.collect.disturbances import DisturbanceSettings
from servoid.tools.learn.collect.episode_cutter import EpisodeCutter
from servoid.tools.learn.collect.skills import Commands


def test_crouched_walks_are_lower_and_slow() -> None:
    """What was asked is what the base does: a planner is to learn that it can be lower as it walks."""
    robot = load_robot()
    fleet = Fleet(robot, 12, None, threads=1, seed=3)
    calm = DisturbanceSettings(noisy_share=0.0, pushed_share=0.0)
    commands = Commands(robot, fleet.n, crouched=1.0)
    cutter = EpisodeCutter(fleet, ExpertPolicy(robot, shape=(fleet.n,)), calm, 3.0, commands)
    seen = []
    for _ in cutter.episodes(
        12 * 100, lambda _: seen.append((commands.lower.copy(), fleet.truth.position[:, 2].copy()))
    ):
        pass
    lower, height = (np.array(part)[80:130] for part in zip(*seen, strict=True))
    assert (lower[-1] > 0.0).all()
    assert (lower <= 0.13 * robot.standing_height).all()
    assert np.corrcoef(lower.mean(0), height.mean(0))[0, 1] < -0.8
    assert height.mean() < robot.walking.height - 0.005
    assert (commands.velocity[:, 0] <= 0.4 * robot.walking.forward).all()

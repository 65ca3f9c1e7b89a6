"""Closed-loop survival of a diffusion checkpoint: what chooses the one to keep, instead of the loss."""

from __future__ import annotations

from dataclasses import replace
from pathlib import Path

import numpy as np

from hw.robot import load_robot

_CHANGE = 125  # ticks between commands


def closed_loop_survival(
    checkpoint: Path, seconds: float, worlds: int, seed: int, robot_name: str = "op3"
) -> dict[str, float]:
    """Run a checkpoint in `worlds` nominal worlds under changing velocity commands, all planned as one batch.

    Returns `survival`, the share of worlds that never fell, and `velocity_error`, the mean planar error [m/s] of
    those, smoothed over a cycle, from 2 s after each command. Uses the settings of configs/policies/diffusion.yaml.
    """
    from policy.diffusion.runtime import load_runtime
    from policy.diffusion.settings import load_settings
    from stack.odometry import load_odometry
    from stack.tasks import load_task
    from tools.train.fleet import Fleet
    from tools.train.planned import PlannedWalker

    robot, settings = load_robot(robot_name), replace(load_settings(), checkpoint=str(checkpoint))
    runtime = load_runtime(robot, settings, load_task("walk", {}, robot.dt).cost)
    fleet = Fleet(robot, worlds, load_odometry(robot), seed=seed)
    walker, everything = PlannedWalker(fleet, runtime, seed), np.ones(worlds, bool)
    fleet.reset(everything)
    walker.reset(everything)
    command = np.zeros((worlds, 3))
    alive, errors = everything.copy(), []
    smooth = np.zeros((worlds, 2))
    for tick in range(round(seconds * robot.rate)):
        if tick % _CHANGE == 25:
            command = np.array([rng.uniform([-0.1, -0.1, -0.8], [0.3, 0.1, 0.8]) for rng in fleet.rngs])
        fleet.observe()
        fleet.step(walker.act(command))
        alive &= ~fleet.truth.fallen
        smooth += robot.dt / 0.48 * (fleet.truth.velocity[:, :2] - smooth)
        if (tick - 25) % _CHANGE >= 100 and tick > 25:
            errors.append(np.where(alive, np.linalg.norm(smooth - command[:, :2], axis=-1), np.nan))
    mean = float(np.nanmean(errors)) if errors and alive.any() else float("nan")
    return {"survival": float(alive.mean()), "velocity_error": mean}

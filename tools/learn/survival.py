"""Closed-loop survival of a network, which selects the checkpoint to keep instead of the loss."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace
from pathlib import Path
from typing import TYPE_CHECKING, Any

import numpy as np

from servoid.hw.robot.description import load_robot
from servoid.tools.learn.progress import counted

if TYPE_CHECKING:
    from servoid.hw.contracts.control import Policy
    from servoid.hw.robot.description import Robot
    from servoid.policy.diffusion.model.config import DenoiserConfig
    from servoid.policy.diffusion.settings import DiffusionSettings
    from servoid.stack.control.fleet import Fleet

_CHANGE = 125  # ticks between commands
_PUSH_EVERY = 50  # ticks
_PUSH = 0.6  # of the top speed forward, in a random direction
_LOW, _HIGH = np.array([[-0.2, -0.2, -0.8], [0.6, 0.2, 0.8]])  # of the top speeds: what is asked
_RANDOMISED = 0.5  # share of worlds with a robot drawn at random
_MEASURED = 2**31  # sets these worlds apart from those that data is collected in, with the same seed


def closed_loop_survival(
    checkpoint: Path, seconds: float, worlds: int, seed: int, robot_name: str = "op3"
) -> dict[str, float]:
    """Run a diffusion checkpoint in `worlds` worlds, all planned as one batch: see `survival_of`."""
    from servoid.policy.checkpoint import read_header
    from servoid.policy.diffusion.model.config import check_fit
    from servoid.stack.control.diffusion import diffusion_policy
    from servoid.stack.tasks import load_task

    robot, head = load_robot(robot_name), read_header(checkpoint)
    settings = planning(check_fit(checkpoint, head, robot), head["training"])
    settings = replace(settings, checkpoint=str(checkpoint))
    policy = diffusion_policy(robot, settings, load_task("walk", {}, robot.dt).objective, shape=(worlds,))
    return survival_of(policy, measured_fleet(robot, worlds, seed), seconds)


def planning(network: DenoiserConfig, training: Mapping[str, Any]) -> DiffusionSettings:
    """The settings of configs/policies/diffusion.yaml as far as the network can serve them.

    Raises ConfigError where it cannot.
    """
    from servoid.policy.diffusion.settings import load_settings

    settings = load_settings().fitted(network, training)
    settings.check(network, training)
    return settings


def measured_fleet(robot: Robot, worlds: int, seed: int) -> Fleet:
    """Robots that are none of those that data is collected on with this seed, half of them drawn at random."""
    from servoid.stack.control.fleet import Fleet
    from servoid.stack.estimation.odometry import load_odometry

    return Fleet(robot, worlds, load_odometry(robot), randomise=_RANDOMISED, seed=seed, tag=_MEASURED)


def survival_of(policy: Policy, fleet: Fleet, seconds: float) -> dict[str, float]:
    """Let a `policy` of shape `(fleet.n,)` walk under changing velocity commands and pushes, drawn by the fleet's seed.

    Pushes, and robots drawn at random, tell networks apart: without them every network that walks at all survives.

    Returns `survival`, the share of worlds that never fell, and `velocity_error`, the mean planar error [m/s] of
    those, smoothed over a cycle, from 2 s after each command.
    """
    from servoid.policy.references.gait import gait_of

    robot, worlds = fleet.robot, fleet.n
    everything = np.ones(worlds, bool)
    cycle, low, high = gait_of(robot).cycle, _LOW * robot.walking.scale, _HIGH * robot.walking.scale
    fleet.reset(everything)
    policy.reset(None, fleet.seeds)
    command = np.zeros((worlds, 3))
    alive, errors = everything.copy(), []
    smooth = np.zeros((worlds, 2))
    for tick in counted(round(seconds * robot.rate), "walking"):
        if tick % _CHANGE == 25:
            command = np.array([rng.uniform(low, high) for rng in fleet.rngs])
        if tick % _PUSH_EVERY == 0 and tick:
            bearing = np.array([rng.uniform(-np.pi, np.pi) for rng in fleet.rngs])
            fleet.worlds.push(_PUSH * robot.walking.forward * np.stack([np.cos(bearing), np.sin(bearing)], axis=-1))
        fleet.drive(policy, command)
        alive &= ~fleet.truth.fallen
        smooth += robot.dt / cycle * (fleet.truth.velocity[:, :2] - smooth)
        if (tick - 25) % _CHANGE >= 100 and tick > 25:
            errors.append(np.where(alive, np.linalg.norm(smooth - command[:, :2], axis=-1), np.nan))
    mean = float(np.nanmean(errors)) if errors and alive.any() else float("nan")
    return {"survival": float(alive.mean()), "velocity_error": mean}

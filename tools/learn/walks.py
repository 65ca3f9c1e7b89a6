"""Walks of robots whose truth is known: what odometry is learned from, and how far it drifts."""

from __future__ import annotations

from collections.abc import Callable
from dataclasses import dataclass
from functools import partial
from typing import TYPE_CHECKING

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction
from servoid.hw.robot.description import Robot
from servoid.policy.mlp import Mlp
from servoid.tools.learn.progress import counted

if TYPE_CHECKING:
    from servoid.hw.contracts.control import Policy

    MakePolicy = Callable[..., Policy]  # takes a shape


def maker(robot: Robot, name: str) -> MakePolicy:
    """What makes a policy for worlds of a `shape`, by the policy's name or a checkpoint's file. Raises ConfigError."""
    from servoid.stack.control.policies import check_policy, make_policy
    from servoid.stack.tasks import load_task

    check_policy(name)
    return partial(make_policy, name, robot, load_task("walk", {}, robot.dt), False)


def mixed(a: dict[str, Array], b: dict[str, Array], seed: int) -> dict[str, Array]:
    """Worlds of two recordings in random order, so that those held out are of both."""
    order = np.random.default_rng(seed).permutation(len(a["rows"]) + len(b["rows"]))
    return {key: np.concatenate([a[key], b[key]])[order] for key in a}


def record(
    robot: Robot, make: MakePolicy, worlds: int, seconds: float, seed: int, odometry: Mlp | None = None
) -> dict[str, Array]:
    """Walk randomised worlds; returns rows `(n, ticks, features)`, starts `(n, ticks)` and errors `(n, ticks, 3)`."""
    from servoid.stack.control.fleet import Fleet

    fleet = Fleet(robot, worlds, odometry, randomise=0.7, seed=seed + 1000)
    policy = make(shape=(fleet.n,))
    ticks = round(seconds * robot.rate)
    rows = np.zeros((worlds, ticks, fleet.estimator.features.size), np.float32)
    errors = np.zeros((worlds, ticks, 3), np.float32)
    starts = np.zeros((worlds, ticks), np.int32)
    everything = np.ones(worlds, bool)
    fleet.reset(everything)
    policy.reset(None, fleet.seeds)
    rng = np.random.default_rng(seed)
    command, start = np.zeros((worlds, 3)), np.zeros(worlds, np.int32)
    noise = rng.uniform(0.0, 0.1, (worlds, 1))
    for k in counted(ticks, "walking"):
        fleet.observe()
        rows[:, k] = fleet.estimator.features.newest
        errors[:, k] = fleet.truth.velocity - fleet.estimator.leg_velocity
        starts[:, k] = start
        due = rng.random(worlds) < 1 / 150
        command[due] = rng.uniform(robot.walking.lower, robot.walking.upper, (int(due.sum()), 3))
        command[due] *= rng.random((int(due.sum()), 3)) < 0.7
        kicked = rng.random(worlds) < 1 / 100
        angle, size = rng.uniform(-np.pi, np.pi, worlds), rng.uniform(0, 0.6 * robot.walking.forward, worlds) * kicked
        fleet.worlds.push(np.stack([size * np.cos(angle), size * np.sin(angle)], -1))
        target = policy.act(fleet.state, fleet.applied, Instruction(command))
        fleet.step(target, noise * rng.standard_normal(target.shape))
        fallen = fleet.truth.fallen
        if fallen.any():
            fleet.reset(fallen)
            policy.reset(fallen, fleet.seeds)
            start[fallen] = k + 1
    return {"rows": rows, "starts": starts, "errors": errors}


@dataclass(frozen=True)
class Drift:
    """Displacement error as a share of the path, yaw drift in rad a minute."""

    median: float
    p90: float
    yaw_p90: float
    walks: int


def drift(
    robot: Robot,
    make: MakePolicy,
    odometry: Mlp | None,
    *,
    walks: int,
    seconds: float,
    seed: int,
    randomise: float = 0.0,
) -> Drift:
    """Walk with commands changed every 5 s and compare the estimate's end with the truth's.

    Walks count that stayed up and went as far as 2 s at full speed. The path is measured from cycle to cycle: within
    one, the gait's sway would add to it, up to its double.
    """
    from servoid.policy.references.gait import gait_of
    from servoid.stack.control.fleet import Fleet

    fleet = Fleet(robot, walks, odometry, randomise=randomise, seed=seed)
    policy = make(shape=(fleet.n,))
    everything = np.ones(walks, bool)
    fleet.reset(everything)
    policy.reset(None, fleet.seeds)
    alive, path, command = everything.copy(), np.zeros(walks), np.zeros((walks, 3))
    turned, start = np.zeros(walks), fleet.truth.position[:, :2].copy()
    last, heading, state = start, fleet.truth.yaw.copy(), fleet.observe()
    ticks, cycle = round(seconds * robot.rate), round(gait_of(robot).cycle * robot.rate)
    for k in counted(ticks, "measuring"):
        if k % (5 * robot.rate) == 0:
            low, high = np.array([[-0.2, -0.2, -0.8], [0.6, 0.2, 0.8]]) * robot.walking.scale
            command = np.array([rng.uniform(low, high) for rng in fleet.rngs])
        fleet.step(policy.act(state, fleet.applied, Instruction(command)))
        state = fleet.observe()
        truth = fleet.truth
        if (k + 1) % cycle == 0 or k == ticks - 1:
            path += np.linalg.norm(truth.position[:, :2] - last, axis=-1)
            last = truth.position[:, :2].copy()
        turned += (truth.yaw - heading + np.pi) % (2 * np.pi) - np.pi
        heading = truth.yaw.copy()
        alive &= ~truth.fallen
    error = np.linalg.norm(state.displacement[:, :2] - (last - start), axis=-1)
    use = alive & (path > 2.0 * robot.walking.forward)
    if not use.any():
        return Drift(np.nan, np.nan, np.nan, 0)
    share, yaw = (error / path)[use], np.abs(state.yaw - turned)[use] * 60.0 / seconds
    return Drift(float(np.median(share)), float(np.quantile(share, 0.9)), float(np.quantile(yaw, 0.9)), int(use.sum()))

"""Bodies for tests of tasks."""

from __future__ import annotations

from functools import partial
from typing import Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import State
from servoid.policy.trajectory import Trajectory

DT = 0.02


def state(x: float = 0.0, y: float = 0.0, yaw: float = 0.0) -> State:
    return State(
        time_ns=0,
        orientation=np.array([np.cos(0.5 * yaw), 0, 0, np.sin(0.5 * yaw)]),
        gravity=np.array([0, 0, -1.0]),
        yaw=np.array(yaw),
        angular_velocity=np.zeros(3),
        velocity=np.zeros(3),
        displacement=np.array([x, y, 0.26]),
        position=np.zeros(20),
        joint_velocity=np.zeros(20),
        contact=np.ones(2),
    )


def moves(
    places: Array, yaw: float = 0.0, velocity: tuple[float, float] = (0.0, 0.0), ticks: Array | None = None
) -> Trajectory:
    """A predicted trajectory through `places` `(horizon, 2)`; `velocity` m/s is as a trajectory has it."""
    displacement = np.array(places, dtype=float)[None]
    horizon = displacement.shape[1]
    return Trajectory(
        displacement=displacement,
        yaw=np.full((1, horizon), yaw),
        velocity=np.tile(np.array(velocity, dtype=float), (1, horizon, 1)),
        yaw_rate=np.zeros((1, horizon)),
        height=np.zeros((1, horizon)),
        gravity=np.tile([0.0, 0.0, -1.0], (1, horizon, 1)),
        joints=np.zeros((1, horizon, 20)),
        ticks=np.arange(1, horizon + 1) if ticks is None else ticks,
        dt=DT,
    )


class Drawn:
    """A task with an episode drawn and what is asked in it, so that a test says `task.instruct` and `task.success`."""

    def __init__(self, task: Any, seed: int = 0) -> None:
        self.episode = task.scenario(np.random.default_rng(seed))
        self.behaviour = task.behaviour(self.episode)
        self.name, self.settings, self.objective = task.name, task.settings, task.objective
        self.scene, self.goal = self.episode.scene, self.episode.goal
        self.percept, self.instruct, self.done = self.behaviour.percept, self.behaviour.instruct, self.behaviour.done
        self.success = partial(task.success, episode=self.episode)
        self.metrics = partial(task.metrics, episode=self.episode)

"""A policy for a task, learned under a motion prior: joint targets around the home pose, from the estimate alone."""

from __future__ import annotations

from collections.abc import Mapping
from pathlib import Path
from typing import Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Adopted, Instruction, State
from servoid.hw.robot.description import Robot
from servoid.policy import checkpoint
from servoid.policy.checkpoint import CheckpointError
from servoid.policy.mlp import Mlp
from servoid.policy.priors.goals import GOALS
from servoid.policy.priors.observation import TaskObservation

KIND = "task_policy"  # of a checkpoint
SLOWING, FADING = 0.5, 0.6  # s for which it slows down when it is asked to stand, and then goes over into the home pose


class TaskPolicy:
    """Drives one robot, or worlds of any leading `shape`. Implements Policy.

    It decides once in `stride` ticks, as often as its prior has frames, and its targets hold until it decides again.
    Asked to stand or for no velocity, which its prior does not know, it slows down, and its motion about the home pose
    fades.
    """

    def __init__(self, robot: Robot, path: Path, shape: tuple[int, ...] = ()) -> None:
        """Raises CheckpointError where the file does not fit."""
        head = checkpoint.read_header(path)
        checkpoint.check(path, head, KIND, robot)
        config = head["config"]
        if config["goal"] not in GOALS:
            raise CheckpointError(f"{path}: its goal '{config['goal']}' is not known to this program: train it again")
        self.task: str = config["task"]
        self._goal, self._walking, self._home = GOALS[config["goal"]], robot.walking, robot.home
        self._observation = TaskObservation(robot, self._goal, shape)
        self._network, _ = Mlp.load(path, KIND, robot, self._observation.size)
        self._reach, self._stride = np.array(config["reach"]), int(config["stride"])
        self._tick, self._dt = np.zeros(shape, int), robot.dt
        self._stood = np.zeros(shape)  # s for which it was asked to stand
        self._target = np.zeros((*shape, len(robot.joints)))

    @property
    def goal(self) -> str:
        """What it sees of what it is asked: see `GOALS`."""
        return self._goal.name

    @property
    def adopted(self) -> Adopted | None:
        return None

    def reset(self, where: Array | None, seeds: Array) -> None:
        self._observation.reset(where)
        self._tick = np.where(np.ones_like(self._tick, bool) if where is None else where, 0, self._tick)

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        due = self._tick % self._stride == 0
        if due.any():
            goal = self._goal.observe(instruction, self._walking)
            observation = self._observation(state, applied, goal, due)
            decided = self._home + self._reach * self._network(observation)
            self._target = np.where(due[..., None], decided, self._target)
        self._tick = self._tick + 1
        stand = instruction.stand | (self._goal.velocity & ~np.any(instruction.velocity, axis=-1))
        self._stood = np.where(stand, self._stood + self._dt, 0.0)
        left = np.clip(1.0 - (self._stood - SLOWING) / FADING, 0.0, 1.0)[..., None]
        return self._home + left * (self._target - self._home)

    def take_events(self) -> tuple[str, ...]:
        return ()

    def repeat(self, plans: Mapping[int, int]) -> None:
        """It makes no plans."""

    def close(self) -> None:
        """It holds nothing open."""


def save_task_policy(
    path: Path, network: Mlp, robot: Robot, config: Mapping[str, Any], about: Mapping[str, Any]
) -> None:
    """Write a policy; `config` names its task, goal, stride and reach [rad by joint]. Raises CheckpointError."""
    network.save(path, checkpoint.header(KIND, robot, config=config, **about))

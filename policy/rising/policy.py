"""A policy that gets up, learned: joint targets around home, or around a lead of clips whose pace it sets."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from pathlib import Path
from typing import Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import State
from servoid.hw.robot.description import Robot
from servoid.policy import checkpoint
from servoid.policy.checkpoint import CheckpointError
from servoid.policy.mlp import Mlp
from servoid.policy.motion.clip import Clip
from servoid.policy.priors.goals import GOALS
from servoid.policy.priors.observation import TaskObservation
from servoid.policy.rising.lead import LeadPace, Rising

KIND = "get_up"  # of a checkpoint


class RisingPolicy:
    """Drives one robot, or worlds of any leading `shape`.

    It decides once in `stride` ticks, and goes from one decision to the next evenly: goals that leap wear gears.
    """

    def __init__(self, robot: Robot, path: Path, clips: Sequence[Clip], shape: tuple[int, ...] = ()) -> None:
        """`clips`: from lying on the front, and on the back. Raises CheckpointError where the file does not fit."""
        head = checkpoint.read_header(path)
        checkpoint.check(path, head, KIND, robot)
        config, self._shape, self._home = head["config"], shape, robot.home
        self._lead = None if config["lead"] is None else Rising(robot, clips, shape, LeadPace(**config["lead"]))
        goal = GOALS[config["goal"]] if self._lead is None else self._lead.goal
        self._observation = TaskObservation(robot, goal, shape)
        self._network, _ = Mlp.load(path, KIND, robot, self._observation.size)
        wanted = len(robot.joints) + (self._lead is not None)
        if self._network.sizes[-1] != wanted:
            raise CheckpointError(f"{path}: decides {self._network.sizes[-1]} numbers, not {wanted}; train it again")
        self._reach, self._stride = np.array(config["reach"]), int(config["stride"])
        self.reset()

    def reset(self) -> None:
        """Begin anew, from however the robot lies at the next tick."""
        self._observation.reset()
        self._tick = 0
        self._before: tuple[Array, Array] | None = None  # gravity and targets of the last tick
        self._last = self._action = np.zeros((*self._shape, self._network.sizes[-1]))

    def __call__(self, state: State, applied: Array) -> Array:
        """Joint targets `(..., n_joints)` rad; `applied` is what became of the last ones. Once a tick."""
        lead = self._lead
        if lead is not None and self._before is None:
            lead.begin(np.ones(self._shape, bool), state.gravity)
        elif lead is not None and self._before is not None:
            gravity, wanted = self._before
            lead.advance(self._action[..., -1], gravity, wanted, applied)
        if self._tick % self._stride == 0:
            seen = np.zeros((*self._shape, 0)) if lead is None else lead.seen
            decided = self._network(self._observation(state, applied, seen))
            self._last, self._action = (self._action if self._tick else decided), decided
        share = (self._tick % self._stride + 1) / self._stride
        self._tick += 1
        joints = (self._last + share * (self._action - self._last))[..., : len(self._home)]
        around = self._home if lead is None else lead.target
        target = around + self._reach * joints
        self._before = state.gravity, target
        return target


def save_rising_policy(
    path: Path, network: Mlp, robot: Robot, config: Mapping[str, Any], about: Mapping[str, Any]
) -> None:
    """Write a policy; `config` names its goal, stride and reach [rad by joint], and the pace of its `lead`, or None.

    Raises CheckpointError.
    """
    network.save(path, checkpoint.header(KIND, robot, config=config, **about))

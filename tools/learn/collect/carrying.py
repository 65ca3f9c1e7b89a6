"""What worlds do while carrying is recorded: each has a box, and a place to bring it to."""

from __future__ import annotations

from collections.abc import Sequence

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.world import Start
from servoid.hw.geometry import headed, turned
from servoid.hw.robot.description import Robot
from servoid.policy.text.captions import NAMES
from servoid.sim.truth import FALL_TILT, SimulatedTruth
from servoid.stack.tasks.learned.carry import Carry


def box_seen(truth: SimulatedTruth) -> Array:
    """The first thing of each world as its robot sees it, as `Instruction.box` has it `(n, 7)`."""
    pose = truth.objects[:, 0]
    place = turned(pose[:, :2] - truth.position[:, :2], -truth.yaw)
    return np.concatenate([place, pose[:, 2:3], headed(pose[:, 3:], -truth.yaw)], -1)


class Carrying:
    """Boxes and places of `n` worlds, drawn from the worlds' own streams. Whoever drives them is told where they are.

    What is recorded beside: `box` `(n, 7)` and `goal` `(n, 2)`, as `Instruction` has them.
    """

    def __init__(self, robot: Robot, n: int) -> None:
        self._task = Carry(robot)
        self.velocity, self.lower = np.zeros((n, 3)), np.zeros(n)
        self.skill = np.full(n, NAMES.index("stand"))
        self.columns = {"box": np.zeros((n, 7)), "goal": np.zeros((n, 2))}
        self._places = np.zeros((n, 2))  # m, in the frame that the episode began in
        self._boxes = np.tile(self._task.place(np.random.default_rng(0)), (n, 1, 1))

    def start(self, rngs: Sequence[np.random.Generator], where: Array) -> Start:
        for i in np.flatnonzero(where).tolist():
            self._boxes[i] = self._task.place(rngs[i])
            self._places[i] = self._task.draw(rngs[i], np.zeros(2))
        return Start(objects=self._boxes)

    def begin(self, ids: Array) -> None:
        """Nothing changes within an episode."""

    def advance(self, rngs: list[np.random.Generator]) -> None:
        """Nothing changes within an episode."""

    def instruction(self, state: State, truth: SimulatedTruth) -> Instruction:
        """Where the boxes and their places are, now."""
        told = self._task.instruct(self._places, state)
        assert told.goal is not None
        self.columns = {"box": box_seen(truth), "goal": told.goal}
        return Instruction(self.velocity, goal=told.goal, box=self.columns["box"])

    def fallen(self, truth: SimulatedTruth) -> Array:
        """Which worlds have fallen `(n,)`: by their tilt, since who squats is low."""
        toppled: Array = -truth.gravity[:, 2] < np.cos(FALL_TILT)
        return toppled

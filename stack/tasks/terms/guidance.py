"""The guidance cost of a predicted trajectory: a weighted sum of terms, each for one thing that an instruction holds.

Each term gives its cost `(batch,)` and its slope on the trajectory, both in numpy: a planner takes the gradient in
every network call, and torch takes many times longer for so little.
"""

from __future__ import annotations

from collections.abc import Callable, Iterator
from dataclasses import dataclass
from typing import Any

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction
from servoid.policy.trajectory import Slope, SlopedCost, Trajectory, sloped
from servoid.stack.tasks.terms.body import Build, bar_cost, reach_cost
from servoid.stack.tasks.terms.motion import ground_cost, standing_cost, twist_cost
from servoid.stack.tasks.terms.places import goal_cost, obstacle_cost, path_cost, way_cost
from servoid.stack.tasks.terms.weights import Weights


@dataclass(frozen=True)
class TotalCost(SlopedCost):
    """Sum of the terms of everything that the instruction holds.

    The terms for goal, path and obstacles are means over the horizon, so that weights do not depend on its length.
    """

    weights: Weights
    build: Build | None = None  # of the robot, where a term is about parts of its body

    def slope(self, trajectory: Trajectory, instruction: Instruction) -> tuple[Array, Slope]:
        total, slope = np.zeros(trajectory.yaw.shape[:-1]), Slope()
        for cost, part in self._terms(trajectory, instruction):
            total = total + cost
            for name, values in part.items():
                slope[name] = slope[name] + values if name in slope else values
        return total, slope

    def _terms(self, trajectory: Trajectory, asked: Instruction) -> Iterator[tuple[Array, Slope]]:
        w = self.weights
        if w.twist:
            yield twist_cost(trajectory, asked.velocity, w)
        if asked.ground is not None and (w.speed > 0.0 or w.steering > 0.0 or w.heading > 0.0):
            yield ground_cost(trajectory, asked.ground, w)
        if asked.goal is not None and (w.goal > 0.0 or w.facing > 0.0 or w.waypoint > 0.0):
            yield goal_cost(trajectory, asked.goal, w)
        if asked.distances is not None and (w.way > 0.0 or w.along > 0.0):
            yield way_cost(trajectory, asked.distances, w)
        if asked.path is not None and w.path > 0.0:
            yield path_cost(trajectory, asked.path, w)
        if asked.obstacles is not None and len(asked.obstacles) and (w.repulsion > 0.0 or w.avoidance > 0.0):
            yield obstacle_cost(trajectory, asked.obstacles, w)
        if self.build is not None and asked.targets and w.reach > 0.0:
            yield reach_cost(trajectory, asked.targets, self.build, w)
        if self.build is not None and asked.bars is not None and w.bar > 0.0:
            yield bar_cost(trajectory, asked.bars, self.build, w)


@dataclass(frozen=True)
class Stopping(SlopedCost):
    """A task's cost, until the robot shall stand: then standing is all that counts.

    With a cost of places alone nothing else asks for it, and a robot walks on while it is lowered.
    """

    cost: Callable[[Trajectory, Instruction], Any]

    def slope(self, trajectory: Trajectory, instruction: Instruction) -> tuple[Array, Slope]:
        if instruction.stand:
            return standing_cost(trajectory)
        return sloped(self.cost).slope(trajectory, instruction)

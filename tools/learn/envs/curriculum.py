"""What a tracker learns to follow, whatever it is: the gait and clips, or a planner's plans."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from typing import Protocol

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Reference, ReferenceFrames, State
from servoid.hw.contracts.world import Start
from servoid.policy.motion.clip import Clip
from servoid.sim.truth import SimulatedTruth


class Curriculum(Protocol):
    """What the worlds of a tracker's training follow, and how their episodes begin and end."""

    @property
    def reference(self) -> Reference: ...

    @property
    def clips(self) -> Sequence[Clip]:
        """Those that are learned."""
        ...

    @property
    def closing(self) -> Array:
        """Worlds whose episode has come to its end `(n,)` bool."""
        ...

    @property
    def on_clip(self) -> Array:
        """Which worlds are judged by how near they are to what they follow, and not as walks `(n,)`."""
        ...

    @property
    def phase(self) -> Array:
        """How far each world is through what it follows `(n,)`, 0 to 1."""
        ...

    @property
    def measures(self) -> Mapping[str, float]:
        """What is logged, by column."""
        ...

    def schedule(self, progress: float) -> None:
        """Make it as hard as it should be at `progress` of the training, 0 to 1."""

    def begin(self, where: Array, rngs: Sequence[np.random.Generator]) -> Start:
        """Draw how the worlds `where` `(n,)` bool begin; a row for every world. Call `enter` once they have begun."""
        ...

    def enter(self, where: Array, rngs: Sequence[np.random.Generator]) -> None:
        """Begin the references of episodes that have begun in the worlds `where`."""

    def look(self, state: State, applied: Array) -> None:
        """Take in what the robots see, once a tick, before the reference is asked."""

    def led(self, target: Array) -> Array:
        """Joint targets `(n, n_joints)` rad as they are sent, where the tracker has `target`."""
        ...

    def failed(self, truth: SimulatedTruth, frames: ReferenceFrames) -> Array:
        """Worlds `(n,)` whose episode is over, after a tick in which `frames` were to be reached."""
        ...

    def learn(self, measured: Array, asked: Array, failed: Array) -> None:
        """Take in twists `(n, 3)`, means over a cycle, and which worlds have failed."""

    def go_on(self, ticks: Array, applied: Array, rngs: Sequence[np.random.Generator]) -> None:
        """By a tick: other commands, and other references where they are due."""

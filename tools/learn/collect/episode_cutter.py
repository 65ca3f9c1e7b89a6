"""Runs a fleet under random commands and disturbances, and cuts what happened into episodes worth learning from."""

from __future__ import annotations

from collections.abc import Callable, Iterator, Sequence
from dataclasses import dataclass
from typing import Protocol

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, Policy, State
from servoid.hw.contracts.world import Start
from servoid.policy.features import raw_layout, raw_row
from servoid.sim.truth import SimulatedTruth
from servoid.stack.control.fleet import Fleet
from servoid.tools.learn.collect.disturbances import Disturbances, DisturbanceSettings
from servoid.tools.learn.collect.skills import Commands

FALL_SECONDS = 1.0  # dropped from the end of an episode that fell: nobody shall learn how
SHORTEST_SECONDS = 2.0  # of what is left
_HOPELESS = 20  # ticks walked for one that is kept: no dataset will come of it


@dataclass(frozen=True)
class RecordedEpisode:
    """Rows of one episode by column `(ticks, size)` float32, and the number of each tick's skill `(ticks,)`."""

    columns: dict[str, Array]
    skill: Array


class Drilled(Protocol):
    """What the worlds are asked: `Commands`, `Performances` or `Carrying`."""

    velocity: Array  # (n, 3) m/s forward, m/s left, rad/s
    lower: Array  # (n,) m that the base shall be lower than it walks
    skill: Array  # (n,) number of the dataset's task

    @property
    def columns(self) -> dict[str, Array]:
        """What else is recorded, `(n, size)` by column."""
        ...

    def start(self, rngs: Sequence[np.random.Generator], where: Array) -> Start | None:
        """How the next episodes of the worlds `where` `(n,)` bool begin, a row for each world; None: standing."""
        ...

    def begin(self, ids: Array) -> None:
        """Episodes begin in the worlds `ids`."""
        ...

    def instruction(self, state: State, truth: SimulatedTruth) -> Instruction:
        """What whoever drives the worlds is told at a tick."""
        ...

    def advance(self, rngs: list[np.random.Generator]) -> None:
        """By a tick, before anything is read."""
        ...

    def fallen(self, truth: SimulatedTruth) -> Array:
        """Which worlds have fallen `(n,)`."""
        ...


class EpisodeCutter:
    """Records a fleet. Row k of an episode holds the state at tick k, and what was decided and done on it.

    `observation.state` is the estimate, `action` the expert's target after the limits (the label), `action_applied`
    what ran instead, with noise, and `command` what was asked. `begun` and `fell` count episodes; those that are
    still walking when the last frame is in count as begun.
    """

    def __init__(
        self,
        fleet: Fleet,
        policy: Policy,
        settings: DisturbanceSettings,
        seconds: float,
        script: Drilled | None = None,
    ) -> None:
        """Episodes end after `seconds`, or with a fall. `policy` is of shape `(fleet.n,)`; without a `script` it is
        asked to walk by `Commands`."""
        robot = fleet.robot
        self.fleet, self._policy = fleet, policy
        self.ticks = round(seconds * robot.rate)
        self._drop, self._shortest = round(FALL_SECONDS * robot.rate), round(SHORTEST_SECONDS * robot.rate)
        if self.ticks < self._drop + self._shortest:
            raise ConfigError(
                f"episodes of {seconds:g} s are too short: at least {FALL_SECONDS + SHORTEST_SECONDS:g} s are needed"
            )
        self._script: Drilled = script or Commands(robot, fleet.n)
        self._disturbances = Disturbances(robot, fleet.n, settings)
        n = len(robot.joints)
        sizes = {"observation.state": raw_layout(n).size, "action": n, "action_applied": n, "command": 3}
        sizes |= {name: values.shape[1] for name, values in self._script.columns.items()}
        self._rows = {name: np.zeros((fleet.n, self.ticks, size), np.float32) for name, size in sizes.items()}
        self._skills = np.zeros((fleet.n, self.ticks), np.int64)
        self._length = np.zeros(fleet.n, int)
        self.begun, self.fell, self.walked = 0, 0, 0

    def episodes(self, frames: int, progress: Callable[[int], None] | None = None) -> Iterator[RecordedEpisode]:
        """Episodes of at least `frames` ticks together, in the order in which they end.

        The last ones are cut short, and lose their last second like those that fell: it is not known whether they
        were falling. `progress` is told each tick how many frames are recorded. Raises ConfigError when the robot
        falls so soon that nothing is kept.
        """
        done, kept = np.ones(self.fleet.n, bool), 0
        while True:
            self._start(done)
            self._tick()
            fallen = self._script.fallen(self.fleet.truth)
            done = fallen | (self._length == self.ticks)
            self.fell += int(fallen.sum())
            worth = self._worth(self._length)
            yield from self._cut(ended := np.where(fallen, worth, self._length * done))
            kept += int(ended.sum())
            under_way = np.where(done, 0, worth)
            total = kept + int(under_way.sum())
            if progress:
                progress(total)
            if total >= frames:
                break
            if self.walked > _HOPELESS * total + self.fleet.n * self.ticks:
                raise ConfigError(
                    f"{self.fell} of {self.begun} episodes fell, most of them at once, and {total} frames were kept: "
                    "use another --policy"
                )
        yield from self._cut(under_way)

    def _worth(self, length: Array) -> Array:
        """Ticks to keep of episodes of `length` ticks whose end is not to be kept; 0: too short."""
        left = length - self._drop
        return np.where(left >= self._shortest, left, 0)

    def _start(self, where: Array) -> None:
        ids = np.flatnonzero(where)
        if not len(ids):
            return
        self.fleet.draw(where)
        self.fleet.reset(where, self._script.start(self.fleet.rngs, where))
        self._policy.reset(where, self.fleet.seeds)
        self._script.begin(ids)
        self._disturbances.reset(ids, self.fleet.rngs)
        self._length[ids] = 0
        self.begun += len(ids)

    def _tick(self) -> None:
        fleet, rngs = self.fleet, self.fleet.rngs
        state = fleet.observe()
        self._script.advance(rngs)
        fleet.worlds.push(self._disturbances.push(rngs))
        command = self._script.velocity
        target = self._policy.act(state, fleet.applied, self._script.instruction(state, fleet.truth))
        clean = fleet.step(target, self._disturbances.noise(rngs))
        worlds, at = np.arange(fleet.n), self._length
        values = {"observation.state": raw_row(state), "action": clean, "action_applied": fleet.applied}
        for name, value in (values | {"command": command} | self._script.columns).items():
            self._rows[name][worlds, at] = value
        self._skills[worlds, at] = self._script.skill
        self._length += 1
        self.walked += fleet.n

    def _cut(self, lengths: Array) -> Iterator[RecordedEpisode]:
        """The first `lengths` `(n,)` ticks of each world's episode; 0: none."""
        for world in np.flatnonzero(lengths):
            length = lengths[world]
            columns = {name: rows[world, :length].copy() for name, rows in self._rows.items()}
            yield RecordedEpisode(columns, self._skills[world, :length].copy())

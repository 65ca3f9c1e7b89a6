"""How a robot comes to a stand where it strikes.

A planner goes on with its steps for a while, by some centimetres, and a bag that stands just before the toes is walked
over by that. So the robot stops early, stands, and steps again where it came to a stand elsewhere.
"""

from __future__ import annotations

from dataclasses import dataclass, field

import numpy as np

from servoid.hw.contracts.body import Array

COAST = 0.3  # s for which steps go on
BEGINS = 0.4  # s until they are as they were asked for
STAND_SECONDS = 0.8  # in which it comes to a stand
SLACK = 0.25  # of how far off it may be, that is allowed more each time that it has come to a stand
# m farther off that it stays for each m that it is aside and each rad that it is turned, at most so many m: it steps in
# from straight before the thing, as turning and stepping aside let it drift.
ASIDE, TURNED, MOST = 0.7, 0.1, 0.1


@dataclass
class Standstill:
    dt: float
    since: int | None = None  # tick from which on it is asked to stand
    _times: int = 0
    _steps: Array = field(default_factory=lambda: np.zeros(2))  # m/s

    def stands(self, tick: int) -> bool:
        """Whether it is coming to a stand."""
        return self.since is not None and tick - self.since < round(STAND_SECONDS / self.dt)

    @property
    def slack(self) -> float:
        """Times how far off it may be."""
        return 1.0 if self.since is None else 1.0 + SLACK * self._times

    def left(self, ahead: Array) -> Array:
        """Of the way `ahead` `(2,)` m, what is left once it has come to a stand."""
        return np.asarray(ahead - COAST * self._steps)

    def step(self, velocity: Array) -> None:
        """It is asked to step at `(2,)` m/s."""
        self.since = None
        self._steps = self._steps + (velocity - self._steps) * self.dt / BEGINS

    def stand(self, tick: int) -> bool:
        """It is where it shall be; whether it has come to a stand there. If not, it is asked to."""
        if self.since is not None:
            return True
        self.since, self._steps = tick, np.zeros(2)
        self._times += 1
        return False


def farther(aside: float, turn: float) -> float:
    """m that a robot stays farther off a thing, being so many m aside of the way to it and turned by so many rad."""
    return min(ASIDE * abs(aside) + TURNED * abs(turn), MOST)

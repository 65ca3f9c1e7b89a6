"""Many robots under the loop's own chain: simulated sensors, the estimator, and the run-time limits.

Training, collection and the survival checks all drive a Fleet, so that what learns sees what runs; what drives it are
the policies that a run has, of shape `(n,)`.
"""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array, Command, Mode
from servoid.hw.contracts.control import Instruction, Policy, State
from servoid.hw.contracts.world import Start
from servoid.hw.robot.description import Robot
from servoid.hw.seeds import generator
from servoid.policy.mlp import Mlp
from servoid.sim.truth import SimulatedTruth
from servoid.sim.worlds import Worlds
from servoid.stack.estimation.estimator import Estimator
from servoid.stack.safety.limits import limit

_BIAS_LEFT = 0.0005  # rad/s of gyro bias that standing before a run leaves


class Fleet:
    """`n` robots. `randomise` is the share of episodes on a randomised robot.

    Episodes draw from streams of their own by `seed`, or by `(seed, tag)`, so that what is measured is not what was
    trained on. A tag is beyond the number of any world: a stream that ends in zeros is that of the shorter one.
    """

    def __init__(
        self,
        robot: Robot,
        n: int | Worlds,
        odometry: Mlp | None,
        *,
        randomise: float = 0.0,
        seed: int = 0,
        tag: int | None = None,
        threads: int = 0,
    ) -> None:
        """`n` may be worlds that are there, with a scene say, which say themselves how they are randomised."""
        self.worlds = n if isinstance(n, Worlds) else Worlds(robot, n, threads=threads, randomise=randomise)
        self.robot, self.n = robot, (count := self.worlds.n)
        self._stream = [seed] if tag is None else [seed, tag]
        self.estimator = Estimator(robot, odometry, (count,))
        self.applied = np.tile(robot.home, (count, 1))
        self.rngs = [np.random.default_rng(0)] * count
        self._episodes = np.zeros(count, int)  # begun
        self._drawn = np.zeros(count, bool)  # worlds whose next episode has its stream already
        self._seed = seed
        self._ones = np.ones((count, len(robot.joints)))
        self.state: State

    @property
    def truth(self) -> SimulatedTruth:
        """The worlds' truth, for rewards and evaluation."""
        return self.worlds.truth

    @property
    def seeds(self) -> Array:
        """A seed `(n,)` for who drives each world in its present episode."""
        return self._seed + np.arange(self.n) + self.n * np.maximum(self._episodes - 1, 0)

    def draw(self, where: Array) -> None:
        """Give the worlds `where` `(n,)` bool the streams of their next episodes, for whoever draws how they begin; the
        `reset` that follows goes on with them."""
        for i in np.flatnonzero(where).tolist():
            self._draw(i)
            self._drawn[i] = True

    def _draw(self, i: int) -> None:
        self.rngs[i] = generator(*self._stream, int(i), int(self._episodes[i]))
        self._episodes[i] += 1

    def reset(self, where: Array, start: Start | None = None) -> None:
        """Begin new episodes in the worlds `where` `(n,)` bool; `start` has a row for every world.

        Call `observe` afterwards: a reset changes what the sensors say.
        """
        ids = np.flatnonzero(where)
        if not len(ids):
            return
        for i in ids[~self._drawn[ids]].tolist():
            self._draw(i)
        self._drawn[ids] = False
        start = Start() if start is None else start.of(ids)
        self.worlds.reset(ids, [self.rngs[i] for i in ids], start)
        bias = np.zeros((self.n, 3))
        for i in ids:
            bias[i] = self.worlds.bodies[i].gyro_bias + self.rngs[i].normal(0.0, _BIAS_LEFT, 3)  # type: ignore[union-attr]
        self.estimator.reset(where, bias)
        self.applied = self.applied.copy()  # `step` gave the old array away as a label
        self.applied[ids] = self.robot.home if start.joints is None else start.joints

    def observe(self) -> State:
        """Read the sensors and estimate."""
        self.state = self.estimator.update(self.worlds.observe(), self.applied)
        return self.state

    def step(self, target: Array, noise: Array | None = None) -> Array:
        """Apply joint targets `(n, n_joints)` for a tick; returns them as the limits let them through.

        `noise` is added after that and limited again: the label stays clean while the motion is not.
        """
        clean = limit(target, self.applied, self.robot)
        self.applied = clean if noise is None else limit(clean + noise, self.applied, self.robot)
        self.worlds.step(Command(self.applied, self._ones, Mode.ACTIVE))
        return clean

    def drive(self, policy: Policy, command: Array, noise: Array | None = None) -> Array:
        """Observe, and do for a tick what `policy`, of shape `(n,)`, decides under velocities `(n, 3)`; see `step`."""
        return self.step(policy.act(self.observe(), self.applied, Instruction(command)), noise)

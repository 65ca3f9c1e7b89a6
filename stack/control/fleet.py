"""Many robots under the loop's own chain: simulated sensors, the estimator, and the run-time limits.

Training, collection and the survival checks all drive a Fleet, so that what learns sees what runs.
"""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array, Command, Mode
from servoid.hw.contracts.control import State
from servoid.hw.robot.description import Robot
from servoid.policy.mlp import Mlp
from servoid.sim.truth import Truth
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
        n: int,
        odometry: Mlp | None,
        *,
        randomise: float = 0.0,
        seed: int = 0,
        tag: int | None = None,
        threads: int = 0,
    ) -> None:
        self.robot, self.n = robot, n
        self._stream = [seed] if tag is None else [seed, tag]
        self.worlds = Worlds(robot, n, threads=threads, randomise=randomise)
        self.estimator = Estimator(robot, odometry, (n,))
        self.applied = np.tile(robot.home, (n, 1))
        self.rngs = [np.random.default_rng(0)] * n
        self._episodes = np.zeros(n, int)
        self._ones = np.ones((n, len(robot.joints)))
        self.state: State

    @property
    def truth(self) -> Truth:
        """The worlds' truth, for rewards and evaluation."""
        return self.worlds.truth

    def reset(self, where: Array, joints: Array | None = None) -> None:
        """Start new episodes in the worlds `where` `(n,)` bool, at pose `joints` `(n, n_joints)` (default: home).

        Call `observe` afterwards: a reset changes what the sensors say.
        """
        ids = np.flatnonzero(where)
        if not len(ids):
            return
        for i in ids:
            self.rngs[i] = np.random.default_rng([*self._stream, int(i), int(self._episodes[i])])
            self._episodes[i] += 1
        pose = np.tile(self.robot.home, (len(ids), 1)) if joints is None else joints[ids]
        self.worlds.reset(ids, [self.rngs[i] for i in ids], pose)
        bias = np.zeros((self.n, 3))
        for i in ids:
            bias[i] = self.worlds.bodies[i].gyro_bias + self.rngs[i].normal(0.0, _BIAS_LEFT, 3)  # type: ignore[union-attr]
        self.estimator.reset(where, bias)
        self.applied = self.applied.copy()  # `step` gave the old array away as a label
        self.applied[ids] = pose

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

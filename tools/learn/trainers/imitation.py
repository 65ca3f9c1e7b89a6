"""Begin a tracker with what another one does: a network of other inputs or layers learns it by imitation.

First the teacher acts and is looked at; then the student acts, and the teacher says what it would have done (DAgger:
S. Ross, G. Gordon and D. Bagnell, A Reduction of Imitation Learning and Structured Prediction to No-Regret Online
Learning, 2011).
"""

from __future__ import annotations

from collections.abc import Sequence
from itertools import pairwise

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.policy.mlp import Mlp
from servoid.policy.tracker.observation import TrackerObservation
from servoid.tools.learn.envs.tracking import Tracking
from servoid.tools.learn.progress import counted

_TICKS = 250  # of each round
_ROUNDS = 5  # in the first of which the teacher acts
_PASSES = 3  # over what was seen, after each round
_BATCH = 2048
_RATE = 1e-3
_NOISE = 0.15  # of what acts


class Teacher:
    """A trained tracker in a tracking environment. One that knows the gait alone adds nothing to clips."""

    def __init__(self, env: Tracking, network: Mlp, *, clips: bool) -> None:
        self._env, self._network, self._clips = env, network, clips
        self._observation = TrackerObservation(env.robot, (env.n,), clips=clips)

    def __call__(self) -> Array:
        """What it would do now `(n, n_joints)`. Call once a tick."""
        env = self._env
        self._observation.reset(env.ticks == 0)
        frames = env.reference.frames(self._observation.ahead)
        action = self._network(self._observation(env.fleet.state, env.fleet.applied, frames)) * env.acting
        return action if self._clips else np.where(env.motions.on_clip[:, None], 0.0, action)


def imitate(env: Tracking, teacher: Teacher, hidden: Sequence[int], seed: int) -> Mlp:
    """A network of `hidden` units a layer that does in `env` as its teacher."""
    import torch
    from torch import nn

    rng, sizes = np.random.default_rng(seed), (env.observation.size, *hidden, env.action_size)
    dense = [nn.Linear(a, b) for a, b in pairwise(sizes)]
    student = nn.Sequential(*[part for layer in dense for part in (layer, nn.ELU())][:-1])
    seen, told = [], []
    mean, std = np.zeros(sizes[0], np.float32), np.ones(sizes[0], np.float32)
    optimiser = torch.optim.Adam(student.parameters(), _RATE)
    for k in range(_ROUNDS):
        for _ in counted(_TICKS, f"imitating, round {k + 1} of {_ROUNDS}"):
            advice = teacher()
            observed = env.observations["actor"]
            seen.append(observed.astype(np.float16))
            told.append(advice.astype(np.float32))
            acted = advice if k == 0 else student(torch.from_numpy((observed - mean) / std)).detach().numpy()
            env.step(acted + _NOISE * rng.standard_normal(acted.shape))
        x, y = np.concatenate(seen), torch.from_numpy(np.concatenate(told))
        if k == 0:
            mean, std = x.astype(np.float32).mean(0), x.astype(np.float32).std(0) + 0.01
        for _ in range(_PASSES):
            order = rng.permutation(len(x))
            for batch in np.array_split(order, len(x) // _BATCH + 1):
                inputs = torch.from_numpy((x[batch].astype(np.float32) - mean) / std)
                loss = ((student(inputs) - y[batch]) ** 2).mean()
                optimiser.zero_grad()
                loss.backward()
                optimiser.step()
    layers = [(m.weight.detach().numpy().T.copy(), m.bias.detach().numpy().copy()) for m in dense]
    return Mlp(layers, mean, std)

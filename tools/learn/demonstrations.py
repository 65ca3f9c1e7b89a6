"""An actor to begin with: a network that does what was demonstrated, given where the robot came to be (hindsight)."""

from __future__ import annotations

from dataclasses import dataclass
from itertools import pairwise

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction
from servoid.hw.geometry import turned
from servoid.hw.robot.description import Robot
from servoid.hw.robot.mirror import Mirror
from servoid.policy.features import raw_layout, raw_mirror
from servoid.policy.mlp import Mlp
from servoid.policy.priors.goals import SeenGoal
from servoid.policy.priors.observation import TaskObservation
from servoid.policy.recording import DatasetError, Recording
from servoid.tools.learn.progress import counted

AHEAD_SECONDS = (0.48, 2.0)  # how far ahead what came to pass is taken for what was asked
_BATCH = 512
_BOX_MIRROR = Mirror(np.arange(7), np.array([1, -1, 1, 1, -1, 1, -1], np.float32))  # of a place and a quaternion
_RATE = 1e-3  # learning rate at the start
_EPS = 1e-2  # added to the deviation of inputs, as rsl-rl's normaliser adds it


def demonstrated(
    recording: Recording, robot: Robot, goal: SeenGoal, stride: int, rng: np.random.Generator, mirrored: bool = True
) -> tuple[Array, Array]:
    """Observations `(n, size)` and joint targets `(n, n_joints)` rad at the decisions of a recording and, where
    `mirrored`, in a mirror.

    Each is given as a goal what the episode then did, over a time drawn from `AHEAD_SECONDS`: the mean velocity, the
    way it faced, the place where it was; or what it was told, where that is a box and its place. Raises DatasetError
    where no episode is long enough.
    """
    mirror, joints, rows, seen = raw_mirror(robot), Mirror.joints(robot), [], []
    n = len(recording.raw)
    # Both sides, one after the other, so that an episode is one of rows, wherever it lies.
    raw = np.concatenate([recording.raw, mirror(recording.raw)])
    applied = np.concatenate([recording.applied, joints(recording.applied)])
    wanted = np.concatenate([recording.action, joints(recording.action)])
    carried = _told(recording)
    targets = []
    for first, end in [*recording.spans, *(recording.spans + n)][: (1 + mirrored) * len(recording.spans)]:
        decided = np.arange(1, end - first - round(AHEAD_SECONDS[0] * robot.rate), stride)
        if not len(decided):
            continue
        rows.append(first + decided)
        if carried is None:
            asked = _hindsight(raw[first:end], decided, robot, rng)
        else:
            box, place = (x[first + decided] for x in carried)
            asked = Instruction(np.zeros((len(decided), 3)), goal=place, box=box)
        seen.append(goal.observe(asked, robot.walking))
        # What was decided at each tick that the decision lasts: held for as long, it is late by half of that.
        lasting = np.minimum(decided[:, None] + np.arange(stride), end - first - 1)
        targets.append(wanted[first:end][lasting].mean(1))
    if not rows:
        raise DatasetError(f"no episode lasts longer than the {AHEAD_SECONDS[0]:g} s that are looked ahead")
    # All episodes at once, a decision at a time; those that are over repeat their last.
    observe, last = TaskObservation(robot, goal, (len(rows),)), max(map(len, rows))
    at = np.stack([np.r_[row, np.full(last - len(row), row[-1])] for row in rows])
    goals = np.stack([np.concatenate([x, np.repeat(x[-1:], last - len(x), 0)]) for x in seen])
    found = np.stack([observe.of_rows(raw[at[:, i]], applied[at[:, i] - 1], goals[:, i]) for i in range(last)], 1)
    return np.concatenate([found[i, : len(row)] for i, row in enumerate(rows)]), np.concatenate(targets)


def _told(recording: Recording) -> tuple[Array, Array] | None:
    """Poses of the box and places for it, and their mirror images after them; None of a recording without one."""
    if recording.box is None or recording.place is None:
        return None
    box, place = _BOX_MIRROR(recording.box), Mirror.PLANAR(recording.place)
    return np.concatenate([recording.box, box]), np.concatenate([recording.place, place])


def _hindsight(raw: Array, rows: Array, robot: Robot, rng: np.random.Generator) -> Instruction:
    row = raw_layout(len(robot.joints)).split(raw)
    ahead = (rng.uniform(*AHEAD_SECONDS, len(rows)) * robot.rate).astype(int)
    then = np.minimum(rows + ahead, len(raw) - 1)
    seconds = (then - rows)[:, None] / robot.rate
    place = turned((row["displacement"][then] - row["displacement"][rows])[:, :2], -row["yaw"][rows, 0])
    turn = (row["yaw"][then] - row["yaw"][rows] + np.pi) % (2.0 * np.pi) - np.pi
    return Instruction(np.concatenate([place / seconds, turn], -1), goal=place)


@dataclass(frozen=True)
class Mirrors:
    """Of what a network sees, and of what it decides."""

    seen: Mirror
    decided: Mirror


def cloned(
    observations: Array, actions: Array, mirrors: Mirrors | None, hidden: tuple[int, ...], steps: int, seed: int
) -> Mlp:
    """A network with so many `hidden` units, trained on the squared error of actions `(n, action_size)`, and, with
    `mirrors`, to decide in a mirror what it decides: PPO on mirrored samples made one that did not worse."""
    import torch
    from torch import nn

    mean, std = observations.mean(0), observations.std(0) + _EPS
    x, y = torch.from_numpy(observations).float(), torch.from_numpy(actions).float()
    centre, scale = torch.from_numpy(mean).float(), torch.from_numpy(std).float()
    torch.manual_seed(seed)
    dense = [nn.Linear(a, b) for a, b in pairwise([x.shape[1], *hidden, y.shape[1]])]
    network = nn.Sequential(*[part for layer in dense[:-1] for part in (layer, nn.ELU())], dense[-1])
    optimiser = torch.optim.Adam(network.parameters(), _RATE)
    generator = torch.Generator().manual_seed(seed)
    for step in counted(steps, "imitating"):
        for group in optimiser.param_groups:
            group["lr"] = _RATE * (1.0 - 0.98 * step / steps)
        pick = torch.randint(len(x), (_BATCH,), generator=generator)
        if mirrors is None:
            loss = (network((x[pick] - centre) / scale) - y[pick]).square().mean()
        else:
            both = torch.cat([x[pick], mirrors.seen(x[pick])])
            done, mirrored = network((both - centre) / scale).chunk(2)
            loss = (done - y[pick]).square().mean() + (mirrored - mirrors.decided(done)).square().mean()
        optimiser.zero_grad(set_to_none=True)
        loss.backward()
        optimiser.step()
    weights = [(layer.weight.detach().numpy().T, layer.bias.detach().numpy()) for layer in dense]
    return Mlp(weights, mean.astype(np.float32), std.astype(np.float32))

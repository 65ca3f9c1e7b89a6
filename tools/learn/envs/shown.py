"""How the tracker gets up by its clips, as a network that knows no clip can imitate it: what is seen, and its targets."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction
from servoid.hw.robot.description import Robot
from servoid.hw.robot.mirror import Mirror
from servoid.policy.motion.library import Library
from servoid.policy.priors.goals import SeenGoal
from servoid.policy.priors.observation import TaskObservation
from servoid.policy.references.either import GaitOrClip
from servoid.stack.control.fleet import Fleet
from servoid.stack.control.get_up import CLIPS, RATE, ROLLED_SHARE
from servoid.stack.control.tracker import Tracker
from servoid.tools.learn.envs.down import Down
from servoid.tools.learn.progress import counted

_SECONDS = 6.0  # of a try
_AFTER_SECONDS = 0.5  # from a clip's end until it stands by the gait
_STOOD_SECONDS = 1.5  # of standing that are shown
_NOISE, _KEPT = 0.08, 0.8  # rad, of half of the tries: what is shown is how to come back; and what lasts of it a tick


def shown(robot: Robot, goal: SeenGoal, stride: int, down: Down, n: int, seed: int) -> tuple[Array, Array]:
    """Observations `(k, size)` and joint targets `(k, n_joints)` rad at the decisions of those of `n` tries, and in a
    mirror, at whose end the robot stands. Raises ConfigError for a robot without clips or a tracker of them."""
    library = Library(robot)
    clips = [library[name] for name in CLIPS]
    fleet = Fleet(robot, n, None, randomise=0.5, seed=seed, tag=n)
    reference, tracker = GaitOrClip(robot, clips, (n,)), Tracker(robot, "tracker", (n,), clips=True)
    view = TaskObservation(robot, goal, (n,))
    everywhere, joints = np.ones(n, bool), Mirror.joints(robot)
    fleet.draw(everywhere)
    fleet.reset(everywhere, down.draw(fleet.rngs, everywhere))
    noisy, rng = np.arange(n) % 2 == 1, np.random.default_rng([seed, n])
    noise, side, rolled = np.zeros((n, len(robot.joints))), np.zeros(n, int), np.zeros(n, bool)
    ticks, since, stood = np.array([clip.ticks for clip in clips]), np.zeros(n, int), np.zeros(n, int)
    rows: list[tuple[Array, Array]] = []
    targets: list[Array] = []
    kept: list[Array] = []
    for tick in counted(round(_SECONDS * robot.rate), "getting up by clips"):
        state = fleet.observe()
        fleet.estimator.fall()
        now = np.where(state.gravity[:, 0] >= 0.0, 0, 1)
        turned = ~rolled & reference.on_clip & (reference.clip.time < ROLLED_SHARE * ticks[side]) & (now != side)
        begin = everywhere if tick == 0 else turned
        if begin.any():
            rolled, side = rolled | (turned & (tick > 0)), np.where(begin, now, side)
            reference.play(side[begin], fleet.applied, begin, rate=np.full(int(begin.sum()), RATE))
        since = np.where(reference.ended, since + 1, 0)
        if (over := since > _AFTER_SECONDS * robot.rate).any():
            reference.stand(fleet.applied, over)
        if tick % stride == 0:
            told = goal.observe(Instruction(np.zeros((n, 3))), robot.walking)
            seen = view(state, fleet.applied, told)
            rows.append((seen, view.mirror(seen)))
            kept.append(stood < _STOOD_SECONDS * robot.rate)
        target = tracker(state, fleet.applied, reference)
        targets.append(target)
        noise = _KEPT * noise + np.sqrt(1.0 - _KEPT**2) * _NOISE * rng.normal(size=noise.shape)
        fleet.step(target, noise * noisy[:, None])
        reference.advance()
        stood = np.where(fleet.truth.fallen, 0, stood + 1)
    decided = np.stack([np.mean(targets[i : i + stride], 0) for i in range(0, len(targets), stride)])
    keep = np.stack(kept) & (stood > 0)
    plain, mirrored = (np.stack([row[i] for row in rows])[keep] for i in (0, 1))
    return np.concatenate([plain, mirrored]), np.concatenate([decided[keep], joints(decided[keep])])

"""The network of one task policy as another begins with it: whatever differs between them, it moves as it did."""

from __future__ import annotations

from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.policy import checkpoint
from servoid.policy.mlp import Mlp
from servoid.policy.priors.goals import GOALS
from servoid.tools.learn.envs.task_environment import TaskEnvironment

if TYPE_CHECKING:
    from servoid.policy.priors.score_matching.model import Prior, Style

_DRAWN = 64  # windows by which the pose of a style is known


def adopted(path: Path, kind: str, env: TaskEnvironment, style: Style, hidden: tuple[int, ...]) -> Mlp:
    """The network in `path`, of checkpoint `kind`, for the task and under the prior of `env`, in a style.

    Where it sees less of its goal, it acts as if it did not see the rest; where the prior lets an action go elsewhere,
    its targets are the same; and where the style holds the upper body elsewhere, so does it. Raises ConfigError where
    it sees more or decides at another rate, CheckpointError for other hidden layers.
    """
    config = checkpoint.read_header(path).get("config", {})
    more = _more(path, config.get("goal"), env)
    network, _ = Mlp.load(path, kind, env.robot, env.observations["actor"].shape[1] - more)
    network = network.widened(more)
    if list(network.sizes[1:-1]) != list(hidden):
        sizes = list(network.sizes[1:-1])
        raise checkpoint.CheckpointError(
            f"{path}: its hidden layers are {sizes}; give --hidden {' '.join(map(str, sizes))}"
        )
    if config.get("stride", env.stride) != env.stride:
        raise ConfigError(
            f"{path}: decides every {config['stride']} ticks, and here it is every {env.stride}: begin with one that "
            "learned at the rate of this prior"
        )
    theirs = config.get("reach")
    if theirs is not None:
        (weight, bias), share = network.layers[-1], np.ones(env.action_size)
        share[: len(theirs)] = theirs / env.reach
        network.layers[-1] = weight * share.astype(np.float32), bias * share.astype(np.float32)
    if env.score.prior is not None and style.upper is not None:
        before = (config.get("style") or {}).get("upper")
        _move(network, env, _moved(env.score.prior, style.upper, before))
    return network


def _more(path: Path, goal: str | None, env: TaskEnvironment) -> int:
    """Numbers of the goal that the task shows, and the network has not seen."""
    task = env.task
    if goal is None or goal not in GOALS:
        return 0
    more = task.seen.size - GOALS[goal].size
    if more < 0 or (more and goal not in task.seen.begins_as):
        raise ConfigError(
            f"{path}: sees its goal in {GOALS[goal].size} numbers ({goal}), and task {task.name} shows "
            f"{task.seen.size} ({task.goal}): begin with a policy that sees as many, or with --demonstrations"
        )
    return more


def _moved(prior: Prior, style: str, before: str | None) -> Array:
    """By how much the joints of the upper body are elsewhere in a style `(n_joints,)` rad: than they were in the style
    of `before`, or than at home."""
    robot = prior.features.robot
    pose = _pose(prior, style) - (_pose(prior, before) if before in prior.config.styles else robot.home)
    pose[robot.leg_index.ravel()] = 0.0
    return pose


def _pose(prior: Prior, style: str | None) -> Array:
    """The mean of the joints in windows drawn in a style `(n_joints,)` rad."""
    from servoid.policy.priors.score_matching.generate import generate
    from servoid.policy.priors.score_matching.model import Style

    windows = generate(prior, _DRAWN, Style(style, style), 0).numpy()
    joints: Array = windows[..., prior.features.layout.slice("position")].mean((0, 1)).astype(float)
    return joints


def _move(network: Mlp, env: TaskEnvironment, offset: Array) -> None:
    """Let it see joints `offset` `(n_joints,)` rad nearer to where they were, and lead them as much further."""
    mean = network.mean.copy()
    for inputs in env.observation.joint_inputs:
        mean[inputs] += offset
    weight, bias = network.layers[-1]
    bias = bias.copy()
    bias[: len(offset)] += offset / env.reach
    network.mean, network.layers[-1] = mean, (weight, bias)

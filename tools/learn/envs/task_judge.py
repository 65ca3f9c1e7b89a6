"""How well a task policy does its task, and in what manner: return, falls, the prior's error, amplitude and cadence."""

from __future__ import annotations

from collections import defaultdict
from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.policy.priors.manner import beside
from servoid.tools.learn.envs.task_environment import TaskEnvironment

Actor = Callable[[Mapping[str, Array]], Array]  # from observations to actions, `(n, action_size)`

_SETTLED = 2.0  # s from the start of an episode: to walk from standing takes a while


@dataclass(frozen=True)
class Walks:
    """What `n` worlds did in an episode, a row a decision."""

    reward: Array  # (decisions, n) of the task, 0 once fallen
    alive: Array  # (decisions, n) whether the world is in its first episode
    ratio: Array  # (decisions, n) the prior's error in multiples of held-out data's
    joints: Array  # (decisions, n, n_joints) rad, the truth
    velocity: Array  # (decisions, n, 2) m/s over the ground
    achieved: Array  # (decisions, n) whether the task was
    shown: dict[str, float]  # shares of windows that show the style that is asked for, from 2 s on; empty: none is


def walk(env: TaskEnvironment, actor: Actor, asked: Array | None = None) -> Walks:
    """One episode in every world from its beginning; `asked` `(size,)` is what is asked all the time, where given."""
    env.reset()
    rows: list[tuple[Array, ...]] = []
    alive, shown = np.ones(env.n, bool), defaultdict[str, list[float]](list)
    for tick in range(env.limit):
        if asked is not None:
            env.ask(asked)  # an episode that has just begun asks for what it draws
        _, done, late = env.step(actor(env.observations))
        rows.append((env.task_reward * alive, alive, env.score.ratio, env.joints, env.ground, env.achieved))
        if tick * env.dt >= _SETTLED and alive.any():
            for name, share in env.score.shown(alive).items():
                shown[name].append(share)
        alive = alive & ~(done & ~late)
    means = {name: float(np.mean(shares)) for name, shares in shown.items()}
    reward, was, ratio, joints, velocity, achieved = (np.stack(column) for column in zip(*rows, strict=True))
    return Walks(reward, was, ratio, joints, velocity, achieved, means)


def measure(env: TaskEnvironment, actor: Actor) -> dict[str, float]:
    """Return and falls over episodes of the task; and the manner, at three speeds where the task is to keep one.

    `env` begins its episodes as it was made to: a run begins standing. The prior's error is the mean over what was
    walked, from 2 s on, in multiples of that of held-out data.
    """
    walks = walk(env, actor)
    settled = round(_SETTLED / env.dt)
    later, prior = walks.alive[settled:], env.score.prior
    results = {
        "return": float(walks.reward.mean()),
        "falls": float(1.0 - walks.alive[-1].mean()),
        "survival": float(walks.alive[-1].mean()),
        "prior_error": float(walks.ratio[settled:][later].mean())
        if prior is not None and later.any()
        else float("nan"),
    }
    results |= walks.shown
    if env.task.achievable:
        first = np.argmax(walks.achieved, 0)[walks.achieved.any(0)]
        results["achieved"] = float(walks.achieved.any(0).mean())
        results["seconds"] = float(np.median(first + 1) * env.dt - env.task.hold) if len(first) else float("nan")
    manners: list[dict[str, float]] = []
    before: Array | None = None
    for share in (0.4, 0.6, 0.8):
        asked = env.task.steady(share * env.robot.walking.forward)
        if asked is None or prior is None or (before is not None and np.array_equal(asked, before)):
            break  # a task that leaves the speed to the policy asks for the same again
        before = asked
        walks = walk(env, actor, asked)
        up = walks.alive[-1]
        if not up.any() or len(walks.joints) <= settled:
            continue
        joints = np.moveaxis(walks.joints[settled:, up], 0, 1)
        speed = float(np.linalg.norm(walks.velocity[settled:, up].mean(0), axis=-1).mean())
        robot = replace(env.robot, rate=round(1.0 / env.dt))  # what is seen at decisions
        manners.append(beside(prior.manner, robot, joints, speed))
    for name in ("amplitude", "amplitude_error", "cadence"):
        results[name] = float(np.mean([manner[name] for manner in manners])) if manners else float("nan")
    return results

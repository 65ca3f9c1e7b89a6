"""The environment that task policies learn in: robots that decide as often as their prior has frames."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.geometry import turned
from servoid.hw.robot.mirror import Mirror
from servoid.policy.mlp import Mlp
from servoid.policy.priors.observation import TaskObservation
from servoid.policy.references.gait import gait_of
from servoid.stack.control.fleet import Fleet
from servoid.tools.learn.envs.score_term import GeneratedStarts, ScoreTerm
from servoid.tools.learn.envs.tasks import LearnedTask, TaskState
from servoid.tools.learn.prior_settings import EpisodeSettings
from servoid.tools.learn.terms import Terms

SMALLEST_REACH, LARGEST_REACH = 0.05, 0.5  # rad of joint target for an action of one
_REACH = 2.0  # deviations of the data: exploration goes where the data goes


@dataclass(frozen=True, slots=True)
class TaskStep:
    """One decision of `n` worlds: what its rewards are made of."""

    task: Array  # (n,) 0..1
    manner: Array  # (n,) 0..1, by the prior
    change: Array  # (n, n_joints) of the action
    effort: Array  # (n, n_joints) N m
    fallen: Array  # (n,)


# The paper adds `task` and `manner`; `both` is what a gate or a product is made of.
REWARDS: Mapping[str, Callable[[TaskStep], Array]] = {
    "task": lambda s: s.task,
    "manner": lambda s: s.manner,
    "both": lambda s: s.task * s.manner,
    "change": lambda s: (s.change**2).mean(-1),
    "effort": lambda s: (s.effort**2).sum(-1),
    "fall": lambda s: s.fallen.astype(float),
}


class TaskEnvironment:
    """`n` worlds: see `servoid.tools.learn.trainers.ppo.Environment`. A tick of that is a decision here."""

    def __init__(
        self, task: LearnedTask, score: ScoreTerm, starts: GeneratedStarts, odometry: Mlp | None, s: EpisodeSettings,
        n: int, seed: int,
    ) -> None:  # fmt: skip
        """Call `reset` first."""
        robot = task.robot
        self.task, self.score, self.starts, self.settings, self.robot, self.n = task, score, starts, s, robot, n
        self.fleet = Fleet(robot, n, odometry, randomise=s.randomised, seed=seed)
        self.observation = TaskObservation(robot, task.seen, (n,))
        self.stride = score.prior.config.stride
        self.dt = self.stride * robot.dt  # s between decisions
        self.reach = np.clip(_REACH * score.prior.joint_deviation, SMALLEST_REACH, LARGEST_REACH)
        joints, feet = Mirror.joints(robot), Mirror.feet(robot)
        extra = Mirror.VECTOR, feet, Mirror.PLANAR, Mirror.SCALAR
        self.mirrors = {"action": joints, "actor": self.observation.mirror}
        self.mirrors["critic"] = Mirror.join(self.observation.mirror, *extra)
        self.action_size = len(robot.joints)
        self.reward = Terms(s.rewards, REWARDS)
        self.terms: dict[str, float] = {}
        self.ticks = np.zeros(n, int)
        self.limit = round(s.episode_seconds / self.dt)
        self.weight = robot.weight or self.fleet.worlds.weight
        self.task_reward = np.zeros(n)  # of the last decision, as are joints [rad] and velocity over the ground [m/s]
        self.joints, self.ground = np.zeros((n, self.action_size)), np.zeros((n, 2))
        self.asked = np.zeros((n, task.size))
        self._next = np.zeros(n, int)
        self._cycle = round(gait_of(robot).cycle / self.dt)  # over which velocity is judged
        self._places = np.zeros((self._cycle + 1, n, 2))  # of the last cycle, newest first
        self._action = np.zeros((n, self.action_size))
        self.observations: dict[str, Array] = {}
        self.progress = 0.0

    @property
    def term_names(self) -> tuple[str, ...]:
        """Of the terms that count."""
        return self.reward.names

    @property
    def measures(self) -> Mapping[str, float]:
        """The prior's error in multiples of held-out data's, now."""
        return {"prior_ratio": float(self.score.ratio.mean())}

    def schedule(self, progress: float) -> None:
        """The prior's reward grows sharper; start states are renewed now and then."""
        self.score.anneal(progress)
        if int(progress * self.settings.renewals) > int(self.progress * self.settings.renewals):
            self.starts.refresh()
        self.progress = progress

    def reset(self) -> None:
        """Begin a new episode in every world."""
        self._reset(np.ones(self.n, bool))
        self._observe()

    def _reset(self, where: Array) -> None:
        fleet = self.fleet
        windows, start = self.starts.draw(fleet.rngs, where)
        fleet.reset(where, start)
        self.observation.reset(where)
        self.score.reset(where)
        self.score.fill(where, windows)
        self.ticks[where] = self._next[where] = 0
        self._action[where] = 0.0
        # As if it had moved so before.
        assert start.velocity is not None
        past = np.arange(self._cycle + 1)[:, None, None] * self.dt * start.velocity[:, :2]
        self._places[:, where] = (fleet.truth.position[:, :2] - past)[:, where]

    def _observe(self) -> None:
        state, truth = self.fleet.observe(), self.fleet.truth
        for i in np.flatnonzero(self.ticks >= self._next):
            rng = self.fleet.rngs[i]
            self.asked[i] = self.task.draw(rng, truth.position[i, :2])
            self._next[i] = self.ticks[i] + round(rng.uniform(*self.task.every) / self.dt)
        goal = self.task.seen.observe(self.task.instruct(self.asked, state), self.robot.walking)
        actor = self.observation(state, self.fleet.applied, goal)
        forward = self.robot.walking.forward
        known = [
            truth.velocity / forward,
            truth.foot_force * (0.9 / self.weight),
            turned(self.velocity, -truth.yaw) / forward,
            np.log(self.score.ratio)[:, None],
        ]
        self.observations = {"actor": actor, "critic": np.concatenate([actor, *known], -1).astype(np.float32)}

    @property
    def velocity(self) -> Array:
        """Over the ground, averaged over the last cycle `(n, 2)` m/s."""
        return (self._places[0] - self._places[-1]) / (self._cycle * self.dt)

    def ask(self, asked: Array) -> None:
        """Ask for `(size,)` in every world from now on, until an episode ends."""
        self.asked[:], self._next[:] = asked, self.limit + 1

    def step(self, action: Array) -> tuple[Array, Array, Array]:
        """Decide `(n, n_joints)`. Returns reward, done and time-out `(n,)`.

        The prior judges the window up to the state that the decision is made in: what this one leads to, it says next.
        """
        manner = self.score(self.fleet.state)
        target = self.robot.home + self.reach * action
        fallen = np.zeros(self.n, bool)
        for tick in range(self.stride):
            if tick:
                self.fleet.observe()
            self.fleet.step(target)
            fallen |= self.fleet.truth.fallen
        self.ticks += 1
        self.asked = self.task.advance(self.asked, self.dt)
        truth = self.fleet.truth
        self._places = np.concatenate([truth.position[None, :, :2], self._places[:-1]])
        known = TaskState(truth.position[:, :2], truth.yaw, self.velocity)
        self.task_reward = self.task.reward(self.asked, known)
        change, self._action = action - self._action, np.array(action)
        step = TaskStep(self.task_reward, manner, change, self.fleet.worlds.effort, fallen)
        reward, self.terms = self.reward(step)
        unlike = (self.score.ratio > self.settings.unlike) if self.settings.unlike else np.zeros(self.n, bool)
        unlike &= self.ticks > self.settings.unlike_after / self.dt
        over = fallen | unlike | self.task.ended(self.asked, known)
        late = (self.ticks >= self.limit) & ~over
        done = over | late
        self.joints, self.ground = truth.joints.copy(), known.velocity
        if done.any():
            self._reset(done)
        self._observe()
        return reward * self.dt, done, late

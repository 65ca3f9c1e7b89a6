"""The environment that task policies learn in: robots that decide once in a few ticks, pushed now and then."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass, replace
from typing import Protocol, TypeAlias

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.world import Start
from servoid.hw.geometry import turned
from servoid.hw.robot.mirror import Mirror
from servoid.policy.mlp import Mlp
from servoid.policy.priors.observation import TaskObservation
from servoid.policy.references.gait import gait_of
from servoid.sim.model import build
from servoid.sim.truth import FALL_TILT
from servoid.sim.worlds import Worlds
from servoid.stack.control.fleet import Fleet
from servoid.stack.safety.limits import clamp
from servoid.stack.tasks.learned import LearnedTask, TaskState
from servoid.tools.learn.collect.carrying import box_seen
from servoid.tools.learn.envs.down import Down
from servoid.tools.learn.envs.score_term import GeneratedStarts, Manner
from servoid.tools.learn.envs.starts import AlongCarrying, AlongClip
from servoid.tools.learn.prior_settings import EpisodeSettings
from servoid.tools.learn.terms import Terms

Starts: TypeAlias = GeneratedStarts | Down | AlongClip | AlongCarrying  # how episodes begin
_FULL_PUSH, _FULL_PACE = 0.5, 0.6  # of the training, over which pushes, and the pace of a lead, grow
_FULL, _STILL = 0.25, 0.2  # rad of error and rad/s at which a servo pushes with nearly all it has, and does not move
_HARD = 40.0  # m/s2 of a knock that counts: four times gravity


@dataclass(frozen=True, slots=True)
class TaskStep:
    """One decision of `n` worlds: what its rewards are made of."""

    task: Array  # (n,) 0..1
    manner: Array  # (n,) 0..1, by the prior
    change: Array  # (n, n_joints) of the action
    jerk: Array  # (n, n_joints) change of that
    effort: Array  # (n, n_joints) N m
    shock: Array  # (n,) m/s2: the greatest specific force on the base
    blocked: Array  # (n,) joints that push with nearly all they have, and do not move
    beyond: Array  # (n, n_joints) rad that targets are out of range
    fallen: Array  # (n,)


# The paper adds `task` and `manner`; `both` is what a gate or a product is made of.
REWARDS: Mapping[str, Callable[[TaskStep], Array]] = {
    "task": lambda s: s.task,
    "manner": lambda s: s.manner,
    "both": lambda s: s.task * s.manner,
    "change": lambda s: (s.change**2).mean(-1),
    "jerk": lambda s: (s.jerk**2).mean(-1),
    "effort": lambda s: (s.effort**2).sum(-1),
    "shock": lambda s: np.maximum(s.shock / _HARD - 1.0, 0.0),
    "blocked": lambda s: s.blocked,
    "beyond": lambda s: s.beyond.sum(-1),
    "fall": lambda s: s.fallen.astype(float),
}


class Driver(Protocol):
    """Who drives some of the worlds, too, a tick at a time."""

    def reset(self, where: Array, seeds: Array) -> None:
        """New episodes in the worlds `where` `(n,)` bool."""

    def __call__(self, state: State, applied: Array, told: Instruction, target: Array) -> Array:
        """Joint targets of a tick `(n, n_joints)` rad, `target` where it does not drive."""
        ...


class TaskEnvironment:
    """`n` worlds: see `servoid.tools.learn.trainers.ppo.Environment`. A tick of that is a decision here."""

    def __init__(
        self, task: LearnedTask, score: Manner, starts: Starts | None, odometry: Mlp | None,
        s: EpisodeSettings, n: int, seed: int,
    ) -> None:  # fmt: skip
        """Call `reset` first. Episodes begin as `starts` has them, or without them standing."""
        robot = task.robot
        self.task, self.score, self.settings, self.robot, self.n = task, score, s, robot, n
        self.generated = starts if isinstance(starts, GeneratedStarts) else None
        self.down = starts if isinstance(starts, Down) else None
        self.along = starts if isinstance(starts, AlongClip | AlongCarrying) else None
        scene, known = task.scene, odometry if task.seen.odometry else None
        worlds = n if scene is None else Worlds(robot, n, randomise=s.randomised, model=build(robot, scene))
        self.fleet = Fleet(robot, worlds, known, randomise=s.randomised, seed=seed)
        self.lead = task.lead(n)
        self.beside: Driver | None = None
        self.observation = TaskObservation(robot, task.seen if self.lead is None else self.lead.goal, (n,))
        self.stride, self.reach = score.stride, score.reach
        self.dt = self.stride * robot.dt  # s between decisions
        joints, feet = Mirror.joints(robot), Mirror.feet(robot)
        extra = Mirror.VECTOR, feet, Mirror.PLANAR, Mirror.SCALAR, Mirror.SCALAR, Mirror.VECTOR
        action = joints if self.lead is None else Mirror.join(joints, Mirror.SCALAR)
        self.mirrors = {"action": action, "actor": self.observation.mirror}
        self.mirrors["critic"] = Mirror.join(self.observation.mirror, *extra)
        self.action_size = len(action.index)
        self.reward = Terms(s.rewards, REWARDS)
        self.terms: dict[str, float] = {}
        self.ticks = np.zeros(n, int)
        self.limit = round(s.episode_seconds / self.dt)
        self.weight = robot.weight or self.fleet.worlds.weight
        self.task_reward = np.zeros(n)  # of the last decision, as are joints [rad] and velocity over the ground [m/s]
        self.joints, self.ground = np.zeros((n, len(robot.joints))), np.zeros((n, 2))
        self.asked = np.zeros((n, task.size))
        self._next = np.zeros(n, int)
        self._cycle = round(gait_of(robot).cycle / self.dt)  # over which velocity is judged
        self._places = np.zeros((self._cycle + 1, n, 2))  # of the last cycle, newest first
        self._action, self._change = np.zeros((n, self.action_size)), np.zeros((n, self.action_size))
        self.achieved = np.zeros(n, bool)  # the task, in the last decision
        self._held = np.zeros(n, int)  # decisions in a row at which the task was achieved
        self._next_push = np.zeros(n, int)
        self.observations: dict[str, Array] = {}
        self.progress = 0.0

    @property
    def term_names(self) -> tuple[str, ...]:
        """Of the terms that count."""
        return self.reward.names

    @property
    def measures(self) -> Mapping[str, float]:
        """Beside the rewards: the prior's error, and how often tasks are achieved, by how episodes begin."""
        return {**self.score.measures, **({} if self.down is None else self.down.measures)}

    def schedule(self, progress: float) -> None:
        """The prior's reward grows sharper, pushes harder, a lead faster; start states are renewed now and then."""
        self.score.anneal(progress)
        if self.lead is not None:
            rate = float(np.interp(progress, [0.0, _FULL_PACE], self.settings.lead_rate))
            self.lead.pace = replace(self.lead.pace, rate=rate)
        if self.down is not None:
            self.down.schedule(progress)
        if self.generated is not None and int(progress * self.settings.renewals) > int(
            self.progress * self.settings.renewals
        ):
            self.generated.refresh()
        self.progress = progress

    def reset(self) -> None:
        """Begin a new episode in every world."""
        self._reset(np.ones(self.n, bool))
        self._observe()

    def _reset(self, where: Array) -> None:
        fleet, windows = self.fleet, None
        if self.down is not None:
            start = self.down.draw(fleet.rngs, where)
        elif self.along is not None:
            start = self.along.draw(fleet.rngs, where)
        elif self.generated is not None:
            windows, start = self.generated.draw(fleet.rngs, where)
        else:
            start = Start(joints=np.tile(self.robot.home, (self.n, 1)), velocity=np.zeros((self.n, 3)))
        fleet.reset(where, start)
        if self.lead is not None and self.down is not None:
            self.lead.begin(where, fleet.truth.gravity, self.down.clip, self.down.time)
        self.observation.reset(where)
        if self.beside is not None:
            self.beside.reset(where, fleet.seeds)
        self.score.reset(where)
        if windows is not None:
            self.score.fill(where, windows)
        self.ticks[where] = self._next[where] = self._held[where] = 0
        self._action[where] = self._change[where] = 0.0
        self._next_push[where] = round(self.settings.push_every[0] / self.dt)
        # As if it had moved so before.
        assert start.velocity is not None
        past = np.arange(self._cycle + 1)[:, None, None] * self.dt * start.velocity[:, :2]
        self._places[:, where] = (fleet.truth.position[:, :2] - past)[:, where]

    def _observe(self) -> None:
        state, truth = self._sense(), self.fleet.truth
        for i in np.flatnonzero(self.ticks >= self._next):
            rng = self.fleet.rngs[i]
            self.asked[i] = self.task.draw(rng, truth.position[i, :2])
            self._next[i] = self.ticks[i] + round(rng.uniform(*self.task.every) / self.dt)
        if self.lead is not None:
            goal = self.lead.seen
        else:
            goal = self.task.seen.observe(self._told(state), self.robot.walking)
        actor = self.observation(state, self.fleet.applied, goal)
        forward = self.robot.walking.forward
        known = [
            truth.velocity / forward,
            truth.foot_force * (0.9 / self.weight),
            turned(self.velocity, -truth.yaw) / forward,
            np.log(self.score.ratio)[:, None],
            2.5 / self.robot.walking.height * (truth.position[:, 2:] - self.robot.walking.height),
            truth.gravity,
        ]
        self.observations = {"actor": actor, "critic": np.concatenate([actor, *known], -1).astype(np.float32)}

    def _told(self, state: State) -> Instruction:
        """What is asked, and where the box is, now."""
        box = self.score.box = None if self.task.scene is None else box_seen(self.fleet.truth)
        return replace(self.task.instruct(self.asked, state), box=box)

    def _sense(self) -> State:
        state = self.fleet.observe()
        if self.task.lies:  # as in a run, where a robot that lies learns no bias of its gyro
            self.fleet.estimator.fall()
        return state

    def _push(self) -> None:
        """Push where it is due, each world by its own stream."""
        s, push = self.settings, np.zeros((self.n, 2))
        hardest = s.hardest_push * min(1.0, self.progress / _FULL_PUSH)
        for i in np.flatnonzero(self.ticks >= self._next_push).tolist():
            rng = self.fleet.rngs[i]
            size, angle = rng.uniform(0.0, hardest), rng.uniform(-np.pi, np.pi)
            push[i] = size * np.cos(angle), size * np.sin(angle)
            self._next_push[i] = self.ticks[i] + round(rng.uniform(*s.push_every) / self.dt)
        self.fleet.worlds.push(push)

    @property
    def velocity(self) -> Array:
        """Over the ground, averaged over the last cycle `(n, 2)` m/s."""
        return (self._places[0] - self._places[-1]) / (self._cycle * self.dt)

    def ask(self, asked: Array) -> None:
        """Ask for `(size,)` in every world from now on, until an episode ends."""
        self.asked[:], self._next[:] = asked, self.limit + 1

    def step(self, action: Array) -> tuple[Array, Array, Array]:
        """Decide `(n, n_joints)`. Returns reward, done and time-out `(n,)`.

        Where something else is asked from now on, that is a time-out, too, though the episode goes on: what is asked
        next is chance, and no merit of what was done.
        The prior judges the window up to the state that the decision is made in: what this one leads to, it says next.
        """
        manner = self.score(self.fleet.state)
        before = np.where(self.ticks[:, None] == 0, action, self._action) if self.task.lies else action
        fallen, shock, blocked = np.zeros(self.n, bool), np.zeros(self.n), np.zeros(self.n)
        if self.settings.hardest_push:
            self._push()
        for tick in range(self.stride):
            if tick:
                self._sense()
            act = before + (tick + 1) / self.stride * (action - before)  # as `RisingPolicy` goes from one to the next
            target = self.reach * act[:, : len(self.robot.joints)] + (
                self.robot.home if self.lead is None else self.lead.target
            )
            if self.beside is not None:
                state = self.fleet.state
                target = self.beside(state, self.fleet.applied, self._told(state), target)
            self.fleet.step(target)
            if self.lead is not None:
                self.lead.advance(action[:, -1], self.fleet.state.gravity, target, self.fleet.applied)
            truth = self.fleet.truth
            fallen |= truth.fallen
            shock = np.maximum(shock, truth.shock)
            pushing = np.abs(self.fleet.applied - truth.joints) > _FULL
            blocked += (pushing & (np.abs(truth.joint_velocity) < _STILL)).sum(-1) / self.stride
        self.ticks += 1
        self.asked = self.task.advance(self.asked, self.dt)
        self._places = np.concatenate([truth.position[None, :, :2], self._places[:-1]])
        known = TaskState(
            position=truth.position[:, :2], yaw=truth.yaw, velocity=self.velocity, height=truth.position[:, 2],
            gravity=truth.gravity, angular_velocity=truth.angular_velocity, joints=truth.joints,
            joint_velocity=truth.joint_velocity,
            objects=None if self.task.scene is None else truth.objects,
        )  # fmt: skip
        self.task_reward = self.task.reward(self.asked, known)
        if self.task.grounded:  # who is low has not fallen
            fallen = -truth.gravity[:, 2] < np.cos(FALL_TILT)
        change = action - self._action
        step = TaskStep(
            task=self.task.guided(self.asked, known), manner=manner, change=change, jerk=change - self._change,
            effort=self.fleet.worlds.effort, shock=shock, blocked=blocked,
            beyond=np.abs(target - clamp(target, self.robot)), fallen=fallen,
        )  # fmt: skip
        self._action, self._change = np.array(action), change
        reward, self.terms = self.reward(step)
        unlike = (self.score.ratio > self.settings.unlike) if self.settings.unlike else np.zeros(self.n, bool)
        unlike &= self.ticks > self.settings.unlike_after / self.dt
        over = unlike | self.task.ended(self.asked, known)
        if not self.task.lies:
            over |= fallen
        self._held = np.where(self.task.achieved(known), self._held + 1, 0)
        self.achieved = self._held * self.dt >= self.task.hold
        late = ((self.ticks >= self.limit) | self.achieved) & ~over
        done = over | late
        self.joints, self.ground = truth.joints.copy(), known.velocity
        if done.any():
            if self.down is not None:
                self.down.learn(done, self.achieved)
            self._reset(done)
        other = ~done & (self.ticks >= self._next)
        self._observe()
        return reward * self.dt, done | other, late | other

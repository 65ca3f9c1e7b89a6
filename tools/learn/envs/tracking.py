"""The environment that the tracker learns in: a fleet following the gait under changing commands, and clips, pushed."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import ReferenceFrames
from servoid.hw.geometry import up_vector
from servoid.hw.robot.description import Robot
from servoid.hw.robot.legs import Legs
from servoid.hw.robot.mirror import Mirror
from servoid.policy.mlp import Mlp
from servoid.policy.motion.clip import About, Clip
from servoid.policy.references.gait import Gait
from servoid.policy.tracker.network import observation_of
from servoid.policy.tracker.observation import RESIDUAL
from servoid.policy.tracker.rewards import TERMS, Step
from servoid.stack.control.fleet import Fleet
from servoid.stack.control.tracker import Followers
from servoid.tools.learn.envs.curriculum import Curriculum
from servoid.tools.learn.envs.motions import Motions
from servoid.tools.learn.settings import TrackingSettings
from servoid.tools.learn.terms import Terms

_LYING_PUSH = 0.4  # of a push, on a robot whose reference is not upright


class Tracking:
    """`n` worlds: see `servoid.tools.learn.trainers.ppo.Environment`. The critic sees privileged truth as well."""

    def __init__(
        self,
        robot: Robot,
        n: int,
        odometry: Mlp | None,
        settings: TrackingSettings,
        seed: int = 0,
        clips: Sequence[Clip] = (),
    ) -> None:
        """Call `reset` first. Without `clips` it follows the gait alone, and sees no more than that takes where the
        `clip_share` is 0."""
        self.robot, self.n, self.settings = robot, n, settings
        self.fleet = self._fleet(odometry, seed)
        self.motions = self._followed(clips, seed)
        self.reference = self.motions.reference
        self.observation = observation_of(robot, (n,), clips=settings.clip_share > 0.0, points=settings.points)
        self.teacher = Followers(robot, settings.teacher, settings.walker, (n,)) if settings.teacher else None
        self.taught = np.zeros((n, len(robot.joints)))  # what it would do, as an action
        joints, feet = Mirror.joints(robot), Mirror.feet(robot)
        critic = Mirror.join(
            self.observation.mirror, Mirror.VECTOR, feet, Mirror.vectors(feet),
            *[Mirror.PLANAR, Mirror.FLIPPED] * 2, *[Mirror.SCALAR] * 4, joints,
            Mirror.SCALAR, Mirror.SCALAR, Mirror.VECTOR, Mirror.SCALAR,
        )  # fmt: skip
        self.mirrors = {"action": joints, "actor": self.observation.mirror, "critic": critic}
        self.action_size = len(robot.joints)
        self.acting = ~heads(robot) | settings.points
        self.ticks = np.zeros(n, int)
        self._weight = robot.weight or self.fleet.worlds.weight
        self.limit = round(settings.episode_seconds / robot.dt)
        self.push_scale = 1.0
        self._walk_reward, self._clip_reward = Terms(settings.rewards, TERMS), Terms(settings.clip_rewards, TERMS)
        self.terms: dict[str, float] = {}
        self._next_push = np.zeros(n, int)
        # Of the last cycle, newest at `ticks % cycle`: velocity and yaw rate, measured and asked.
        self._cycle = Gait(robot).cycle_ticks  # over which velocity is judged: within one, a walk sways
        self._twists = np.zeros((self._cycle, n, 6))
        self._twist = np.zeros((n, 6))
        self._targets = np.zeros((3, n, len(robot.joints)))  # the last three, newest first
        self._residuals = np.zeros_like(self._targets)
        self.observations: dict[str, Array] = {}

    @property
    def term_names(self) -> tuple[str, ...]:
        """Of the terms that count: of walking, and of clips."""
        return (*self._walk_reward.names, *(f"clip/{name}" for name in self._clip_reward.names))

    @property
    def measures(self) -> Mapping[str, float]:
        return self.motions.measures

    def _fleet(self, odometry: Mlp | None, seed: int) -> Fleet:
        return Fleet(self.robot, self.n, odometry, randomise=self.settings.randomised, seed=seed)

    def _followed(self, clips: Sequence[Clip], seed: int) -> Curriculum:
        share = self.settings.clip_share if clips else 0.0
        settings = replace(self.settings, clip_share=share)
        return Motions(self.robot, clips or [_still(self.robot)], self.n, settings, seed)

    def reset(self) -> None:
        """Begin a new episode in every world."""
        self._reset(np.ones(self.n, bool))
        self._observe()

    def schedule(self, progress: float) -> None:
        """Pushes grow over the first fifth of the training."""
        self.push_scale = min(1.0, 0.25 + 0.75 * progress / 0.2)
        self.motions.schedule(progress)

    def learn(self) -> None:
        """Once an update of the tracker: what learns along with it. Here nothing does."""

    def _reset(self, where: Array) -> None:
        fleet = self.fleet
        fleet.draw(where)
        fleet.reset(where, self.motions.begin(where, fleet.rngs))
        self.motions.enter(where, fleet.rngs)
        self.observation.reset(where)
        if self.teacher is not None:
            self.teacher.reset(where)
        self.ticks[where] = 0
        self._next_push[where] = 25
        self._twists[:, where], self._twist[where] = 0.0, 0.0
        self._targets[:, where], self._residuals[:, where] = fleet.applied[where], 0.0

    def _observe(self) -> None:
        state = self.fleet.observe()
        self.motions.look(state, self.fleet.applied)
        frames = self.reference.frames(self.observation.ahead)
        self.frames = frames
        self._upright = -up_vector(frames.root_orientation[:, 0])
        actor = self.observation(state, self.fleet.applied, frames)
        if self.teacher is not None:
            target = self.teacher(state, self.fleet.applied, self.reference)
            self.taught = (target - self.observation.base(frames)) / RESIDUAL
        truth, worlds = self.fleet.truth, self.fleet.worlds
        bodies = worlds.bodies
        privileged = np.concatenate(
            [
                truth.velocity / self.robot.walking.forward,
                truth.foot_force * (0.9 / self._weight),
                truth.foot_velocity.reshape(self.n, -1),
                self._twist,
                np.array(
                    [
                        [b.stiffness * 0.1, b.voltage - self.robot.servos[0].voltage, b.friction, b.command_delay * 50]
                        for b in bodies
                        if b
                    ]
                ),
                np.array([b.zero for b in bodies if b]) * 30,
                self.motions.on_clip[:, None],
                self.motions.phase[:, None],
                truth.gravity - self._upright,
                (truth.position[:, 2:] - frames.height[:, :1]) * (2.5 / self.robot.walking.height),
            ],
            -1,
        ).astype(np.float32)
        self.observations = {"actor": actor, "critic": np.concatenate([actor, privileged], -1)}

    def _push(self) -> None:
        """Push where it is due, each world by its own stream, and less where the reference is not upright."""
        s, rate = self.settings, self.robot.rate
        push = np.zeros((self.n, 2))
        for i in np.flatnonzero(self.ticks >= self._next_push):
            rng = self.fleet.rngs[i]
            size, angle = (
                rng.uniform(0, s.hardest_push * self.push_scale * self.robot.walking.forward),
                rng.uniform(-np.pi, np.pi),
            )
            size *= _LYING_PUSH if self._upright[i, 2] > -0.8 else 1.0
            push[i] = size * np.cos(angle), size * np.sin(angle)
            self._next_push[i] = self.ticks[i] + round(rng.uniform(*s.push_every) * rate)
        self.fleet.worlds.push(push)

    def _measure(self) -> None:
        """Average what was measured and what was asked over the last cycle."""
        truth, asked = self.fleet.truth, self.frames
        now = np.concatenate(
            [
                truth.velocity[:, :2],
                truth.angular_velocity[:, 2:],
                asked.velocity[:, 0],
                asked.yaw_rate[:, :1],
            ],
            -1,
        )
        row, worlds = self.ticks % self._cycle, np.arange(self.n)
        self._twist += (now - self._twists[row, worlds]) / self._cycle
        self._twists[row, worlds] = now

    def step(self, action: Array) -> tuple[Array, Array, Array]:
        """Act for a tick with `(n, n_joints)`. Returns reward a tick, done and time-out `(n,)`."""
        frames = self.frames
        target = self.observation.base(frames) + RESIDUAL * action * self.acting
        residual = target - frames.position[:, 0]
        self.fleet.step(self.motions.led(target))
        for past, now in ((self._targets, self.fleet.applied), (self._residuals, residual)):
            past[1:] = past[:-1].copy()
            past[0] = now
        self.ticks += 1
        truth = self.fleet.truth
        failed = self.motions.failed(truth, frames)
        self._measure()
        self.motions.learn(self._twist[:, :3], self._twist[:, 3:], failed)
        reward = self._judge(frames, failed)
        late = ((self.ticks >= self.limit) | self.motions.closing) & ~failed
        done = failed | late
        self._push()
        self.motions.go_on(self.ticks, self.fleet.applied, self.fleet.rngs)
        late |= self.motions.closing & ~done
        done |= late
        if done.any():
            self._reset(done)
        self._observe()
        return reward * self.robot.dt, done, late

    def _judge(self, frames: ReferenceFrames, failed: Array) -> Array:
        """The tick's reward `(n,)`, by the terms of what each world follows."""
        truth = self.fleet.truth
        step = Step(
            velocity=self._twist[:, 0:2],
            yaw_rate=self._twist[:, 2],
            height=truth.position[:, 2],
            gravity=truth.gravity,
            angular_velocity=truth.angular_velocity,
            joints=truth.joints,
            effort=self.fleet.worlds.effort,
            target=self._targets[0],
            target1=self._targets[1],
            target2=self._targets[2],
            residual=self._residuals[0],
            residual1=self._residuals[1],
            residual2=self._residuals[2],
            foot_force=truth.foot_force,
            foot_height=truth.foot_position[..., 2],
            foot_velocity=truth.foot_velocity,
            foot_up=truth.foot_up,
            reference_velocity=self._twist[:, 3:5],
            reference_yaw_rate=self._twist[:, 5],
            reference_height=frames.height[:, 0],
            reference_joints=frames.position[:, 0],
            reference_contact=frames.contact[:, 0],
            reference_gravity=self._upright,
            fallen=failed,
            walking=self.robot.walking,
            weight=self._weight,
        )
        on_clip = self.motions.on_clip
        walk, clip = self._walk_reward(step, ~on_clip), self._clip_reward(step, on_clip)
        self.terms = {**walk[1], **{f"clip/{name}": value for name, value in clip[1].items()}}
        return np.where(on_clip, clip[0], walk[0])


def heads(robot: Robot) -> Array:
    """Joints `(n_joints,)` bool in the mirror's plane that carry no leg: they follow the reference alone, so that what
    is looked at stays in sight."""
    alone = robot.mirror[0] == np.arange(len(robot.joints))
    alone[robot.leg_index.reshape(-1)] = False
    return alone


def _still(robot: Robot) -> Clip:
    """What a robot without clips has one of: it stands at home."""
    height, orientation = Legs(robot).stand(robot.home)
    return Clip(
        "stand", np.tile(robot.home, (2, 1)), np.tile([0.0, 0.0, float(height)], (2, 1)), np.tile(orientation, (2, 1)),
        np.ones((2, len(robot.feet))), About(("stand",), "this program", "Apache-2.0"),
    )  # fmt: skip

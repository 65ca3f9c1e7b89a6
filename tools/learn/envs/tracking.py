"""The environment that the tracker learns in: a fleet following the gait under changing commands and pushes."""

from __future__ import annotations

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot, Walking
from servoid.hw.robot.mirror import Mirror
from servoid.policy.mlp import Mlp
from servoid.policy.references.gait import Gait
from servoid.policy.tracker.observation import AHEAD, RESIDUAL, TrackerObservation
from servoid.policy.tracker.rewards import TERMS, Step
from servoid.stack.control.fleet import Fleet
from servoid.tools.learn.settings import TrackingSettings
from servoid.tools.learn.terms import Terms

_MIXED_SPEED = 0.7  # of the top speed forward


class Tracking:
    """`n` worlds: see `servoid.tools.learn.trainers.ppo.Environment`. The critic sees privileged truth as well."""

    def __init__(self, robot: Robot, n: int, odometry: Mlp | None, settings: TrackingSettings, seed: int = 0) -> None:
        """Call `reset` first."""
        self.robot, self.n, self.settings = robot, n, settings
        self.fleet = Fleet(robot, n, odometry, randomise=settings.randomised, seed=seed)
        self.gait = Gait(robot, (n,))
        self.observation = TrackerObservation(robot, (n,))
        joints, feet = Mirror.joints(robot), Mirror.feet(robot)
        critic = Mirror.join(
            self.observation.mirror, Mirror.VECTOR, feet, Mirror.vectors(feet),
            *[Mirror.PLANAR, Mirror.FLIPPED] * 2, *[Mirror.SCALAR] * 4, joints,
        )  # fmt: skip
        self.mirrors = {"action": joints, "actor": self.observation.mirror, "critic": critic}
        self.action_size = len(robot.joints)
        self.ticks = np.zeros(n, int)
        self._weight = robot.weight or self.fleet.worlds.weight
        self.limit = round(settings.episode_seconds / robot.dt)
        self.push_scale = 1.0
        self.reward = Terms(settings.rewards, TERMS)
        self.terms: dict[str, float] = {}
        self._next_command, self._next_push = np.zeros(n, int), np.zeros(n, int)
        # Of the last cycle, newest at `ticks % cycle`: velocity and yaw rate, measured and asked.
        self._cycle = self.gait.cycle_ticks  # over which velocity is judged: within one, a walk sways
        self._twists = np.zeros((self._cycle, n, 6))
        self._twist = np.zeros((n, 6))
        self._targets = np.zeros((3, n, len(robot.joints)))
        self.observations: dict[str, Array] = {}

    @property
    def term_names(self) -> tuple[str, ...]:
        """Of the terms that count."""
        return self.reward.names

    def reset(self) -> None:
        """Begin a new episode in every world."""
        self._reset(np.ones(self.n, bool))
        self._observe()

    def schedule(self, progress: float) -> None:
        """Pushes grow over the first fifth of the training."""
        self.push_scale = min(1.0, 0.25 + 0.75 * progress / 0.2)

    def _reset(self, where: Array) -> None:
        fleet = self.fleet
        fleet.reset(where)
        self.gait.reset(where)
        self.observation.reset(where)
        self.reward.reset(where)
        self.ticks[where] = self._next_command[where] = 0
        self._next_push[where] = 25
        self._twists[:, where], self._twist[where] = 0.0, 0.0
        self._targets[:, where] = fleet.applied[where]

    def _observe(self) -> None:
        state = self.fleet.observe()
        frames = self.gait.frames(AHEAD)
        self._reference = frames
        actor = self.observation(state, self.fleet.applied, frames)
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
            ],
            -1,
        ).astype(np.float32)
        self.observations = {"actor": actor, "critic": np.concatenate([actor, privileged], -1)}

    def _instruct(self) -> None:
        """Draw new commands and pushes where they are due, each world from its own stream."""
        s, rate = self.settings, self.robot.rate
        command = self.gait.target.copy()
        for i in np.flatnonzero(self.ticks >= self._next_command):
            rng = self.fleet.rngs[i]
            command[i] = _draw(rng, s, self.robot.walking)
            self._next_command[i] = self.ticks[i] + round(rng.uniform(*s.command_every) * rate)
        self.gait.command(command)
        push = np.zeros((self.n, 2))
        for i in np.flatnonzero(self.ticks >= self._next_push):
            rng = self.fleet.rngs[i]
            size, angle = (
                rng.uniform(0, s.hardest_push * self.push_scale * self.robot.walking.forward),
                rng.uniform(-np.pi, np.pi),
            )
            push[i] = size * np.cos(angle), size * np.sin(angle)
            self._next_push[i] = self.ticks[i] + round(rng.uniform(*s.push_every) * rate)
        self.fleet.worlds.push(push)

    def _measure(self) -> None:
        """Average what was measured and what was asked over the last cycle."""
        truth, asked = self.fleet.truth, self._reference
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
        """Act for a tick with residuals `(n, n_joints)`. Returns reward a tick, done and time-out `(n,)`."""
        reference = self._reference.position[:, 0]
        contact = self._reference.contact[:, 0]
        self.fleet.step(reference + RESIDUAL * action)
        self._targets[1:] = self._targets[:-1].copy()
        self._targets[0] = self.fleet.applied
        self.ticks += 1
        truth = self.fleet.truth
        fallen = truth.fallen
        self._measure()
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
            foot_force=truth.foot_force,
            foot_height=truth.foot_position[..., 2],
            foot_velocity=truth.foot_velocity,
            foot_up=truth.foot_up,
            reference_velocity=self._twist[:, 3:5],
            reference_yaw_rate=self._twist[:, 5],
            reference_height=self._reference.height[:, 0],
            reference_joints=reference,
            reference_contact=contact,
            fallen=fallen,
            walking=self.robot.walking,
            weight=self._weight,
        )
        reward, self.terms = self.reward(step)
        late = (self.ticks >= self.limit) & ~fallen
        done = fallen | late
        self._instruct()
        self.gait.advance()
        if done.any():
            self._reset(done)
        self._observe()
        return reward * self.robot.dt, done, late


def _draw(rng: np.random.Generator, s: TrackingSettings, walking: Walking) -> Array:
    """A command `(3,)`: standing, straight ahead, along one other axis, backward, or any mixture."""
    command = rng.uniform(walking.lower, walking.upper)
    slowest, fastest = -walking.backward, walking.forward
    kind = rng.random()
    shares = np.cumsum([s.stand, s.forward, s.single, s.backward])
    if kind < shares[0]:
        return np.zeros(3)
    if kind < shares[1]:
        fast = rng.uniform(fastest - (fastest - slowest) / 3, fastest)
        return np.array([fast if rng.random() < 0.5 else command[0], 0.0, 0.0])
    if kind < shares[2]:
        command[0] = rng.uniform(slowest, 0.0)
        return np.where(np.arange(3) == rng.integers(3), command, 0.0)
    if kind < shares[3]:
        command[0] = rng.uniform(slowest, 0.0)
    elif command[0] > _MIXED_SPEED * fastest:  # no fast walking while turning or side-stepping
        command[0] -= _MIXED_SPEED * fastest
    return command

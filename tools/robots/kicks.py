"""Kicks of a ball, many at once: each candidate on robots of its own, judged by the truth."""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.body import Array, Command, Mode
from servoid.hw.contracts.control import Instruction
from servoid.hw.contracts.world import Scene, SceneObject, Start
from servoid.hw.robot.description import Robot
from servoid.policy.motion.clip import About, Clip, smooth
from servoid.policy.references.clip import ClipReference
from servoid.sim.model import build
from servoid.sim.worlds import Worlds
from servoid.stack.control.tracker import ExpertPolicy
from servoid.stack.estimation.estimator import Estimator
from servoid.stack.estimation.odometry import load_odometry
from servoid.stack.safety.balance import Feedback
from servoid.stack.safety.limits import limit
from servoid.stack.safety.upright import Upright
from servoid.stack.tasks.skills.kick import SIDES, KickSettings

READY_SECONDS = 0.7  # that the robot stands at its home pose, as before a run: it sags and leans as its servos give
LOOK_SECONDS = 0.5  # that the expert stands before the kick
AFTER_SECONDS = 1.0  # that it stands after it
_BLEND_SECONDS = 0.2  # from a kick's last pose to what stands
_TAG = 2**31 - 61  # of the streams that robots are drawn from
_NOW = np.array([0])


@dataclass(frozen=True)
class Kicks:
    """What came of kicks, `(candidates, each)`, by the truth."""

    speed: Array  # m/s, highest of the ball over a tick
    angle: Array  # rad of its way then, from where the robot faced
    lasted: Array  # share of the time until it fell; 1: it did not
    turned: Array  # rad that the robot has turned by in the end
    restless: Array  # speed of the base in the end: m/s and a tenth of rad/s
    hurry: Array  # rad/s by which goals were faster than the guard allows, mean over the kick

    @property
    def stands(self) -> Array:
        return self.lasted >= 1.0


class KickTrial:
    """Kicks with one foot; before and after them the expert stands. Robots and places of the ball are others in each
    `generation`, and the same for every candidate."""

    def __init__(
        self, robot: Robot, candidates: int, each: int, ball: KickSettings, *, randomise: float, seed: int
    ) -> None:
        """`each` worlds a candidate, `randomise` the share of robots that are drawn."""
        self.robot, self.candidates, self.each, self.ball, self._seed = robot, candidates, each, ball, seed
        n = candidates * each
        lies = SceneObject("ball", (ball.ahead, 0.0), (ball.diameter,) * 3, ball.mass)
        scene = Scene(np.zeros((0, 3)), np.zeros((0, 4)), objects=(lies,))
        self._worlds = Worlds(robot, n, threads=1, randomise=randomise, model=build(robot, scene))
        self._estimator = Estimator(robot, load_odometry(robot), (n,))
        self._stands = ExpertPolicy(robot, "expert", (n,))
        self._feedback, self._upright = Feedback(robot), Upright(robot)

    def kick(self, goals: Sequence[Array], gains: Array, foot: str, generation: int) -> Kicks:
        """Candidates by their goals `(ticks, n_joints)` rad each, and their gains `(candidates, 4, 2)` of `Balance`."""
        robot, worlds, n = self.robot, self._worlds, self._worlds.n
        self._begin(foot, generation)
        reference = ClipReference(robot, [_clip(each, len(robot.feet)) for each in goals], (n,))
        length = np.repeat([len(each) for each in goals], self.each)
        gain = np.repeat(gains, self.each, 0)
        ready, after = round(READY_SECONDS * robot.rate), round(AFTER_SECONDS * robot.rate)
        look = ready + round(LOOK_SECONDS * robot.rate)
        fade = round(_BLEND_SECONDS * robot.rate)
        told, truth = Instruction(np.zeros((n, 3)), stand=True), worlds.truth
        applied, offset = np.tile(robot.home, (n, 1)), np.zeros((n, len(robot.joints)))
        speed, way, lasted, hurry = np.zeros(n), np.zeros((n, 2)), np.zeros(n), np.zeros(n)
        alive, place, faced = np.ones(n, bool), truth.objects[:, 0, :2].copy(), truth.yaw.copy()
        ticks = look + int(length.max()) + after
        for tick in range(ticks):
            state = self._estimator.update(worlds.observe(), applied)
            stands = self._stands.act(state, applied, told)
            target = self._upright.goal(state, applied) if tick < ready else stands
            if tick == look:
                reference.play(np.repeat(np.arange(self.candidates), self.each))
                reference.enter(applied)
                faced = truth.yaw.copy()
            if tick >= look:
                over = tick - look - length
                kick = reference.frames(_NOW).position[:, 0]
                kick = self._feedback(kick, state.gravity, state.angular_velocity, gain)
                reference.advance()
                offset = np.where((over == 0)[:, None], applied - target, offset)
                left = 1.0 - smooth((over + 1.0) / fade)
                target = np.where((over >= 0)[:, None], target + left[:, None] * offset, kick)
                fastest = np.abs(target - applied).max(-1) / robot.dt
                hurry += np.where(over < 0, np.maximum(fastest - robot.limits.joint_speed, 0.0), 0.0) / length
            applied = limit(target, applied, robot)
            worlds.step(Command(applied, np.ones_like(applied), Mode.ACTIVE))
            alive &= ~truth.fallen
            lasted += alive / ticks
            here = truth.objects[:, 0, :2].copy()
            velocity, place = (here - place) / robot.dt, here
            faster = (tick >= look) & (np.linalg.norm(velocity, axis=-1) > speed)
            way = np.where(faster[:, None], velocity, way)
            speed = np.linalg.norm(way, axis=-1)
        rest = np.linalg.norm(truth.velocity[:, :2], axis=-1) + 0.1 * np.linalg.norm(truth.angular_velocity, axis=-1)
        found = (speed, _wrapped(np.arctan2(way[:, 1], way[:, 0]) - faced), np.where(alive, 1.0, lasted),
                 _wrapped(truth.yaw - faced), rest, hurry)  # fmt: skip
        return Kicks(*(part.reshape(self.candidates, self.each) for part in found))

    def _begin(self, foot: str, generation: int) -> None:
        n, ball = self._worlds.n, self.ball
        rngs = [np.random.default_rng([self._seed, _TAG, generation, i % self.each]) for i in range(n)]
        off = np.array([rng.uniform(-ball.jitter, ball.jitter, 2) for rng in rngs])
        objects = np.zeros((n, 1, 7))
        objects[:, 0, :2] = np.array([ball.ahead, SIDES[foot] * ball.aside]) + off
        objects[:, 0, 2], objects[:, 0, 3] = ball.diameter / 2, 1.0
        everywhere = np.arange(n)
        self._worlds.reset(everywhere, rngs, Start(objects=objects))
        bias = np.stack([body.gyro_bias for body in self._worlds.bodies if body is not None])
        self._estimator.reset(np.ones(n, bool), bias)
        self._stands.reset(None, everywhere)


def _wrapped(angle: Array) -> Array:
    wrapped: Array = (angle + np.pi) % (2 * np.pi) - np.pi
    return wrapped


def _clip(goals: Array, feet: int) -> Clip:
    """Goals as a clip whose base nobody looks at."""
    ticks = len(goals)
    upright = np.tile([1.0, 0.0, 0.0, 0.0], (ticks, 1))
    about = About(("kick",), "a search", "Apache-2.0")
    return Clip("kick", goals, np.zeros((ticks, 3)), upright, np.ones((ticks, feet)), about)

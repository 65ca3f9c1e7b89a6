"""What each world of the tracker's training follows: the gait under commands, and clips between, chosen where it
fails."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import ReferenceFrames, State
from servoid.hw.contracts.world import Start
from servoid.hw.geometry import up_vector
from servoid.hw.robot.description import Robot, Walking
from servoid.hw.robot.legs import Legs
from servoid.policy.motion.clip import Clip
from servoid.policy.references.either import GaitOrClip
from servoid.policy.references.gait import load_gait
from servoid.sim.truth import SimulatedTruth
from servoid.tools.learn.envs.speeds import Speeds
from servoid.tools.learn.envs.starts import States, along, lying
from servoid.tools.learn.settings import TrackingSettings

_MIXED_SPEED = 0.7  # of the top speed forward
_LYING = 512  # bodies that are dropped
_ALONG = 16  # rollouts of each clip
_STOP_SECONDS = (0.6, 1.2)  # from the command to stand to a clip
_HOLD_SECONDS = (0.1, 0.6)  # of a clip's last frame
_ASTRAY_SECONDS = 0.5  # for which a world that follows a clip may be far from it
_ASTRAY_GRAVITY = 1.0  # squared error of gravity, seen from the base: 60 degrees
_ASTRAY_HEIGHT = 0.3  # of the standing height
_AFTER_SECONDS = 1.5
_GRACE_SECONDS = 1.0  # in which one that lies need not yet lie as the clip
_NEAR = 0.3  # rad, root mean square, between the end of a clip and the beginning of one that goes on from it
_LEARNED = 0.03  # of a clip's success, from one try
_ALWAYS = 0.2  # weight of a clip that never fails, beside 1 of one that always does


class Motions:
    """Of `n` worlds: a reference, and when each goes over to another one.

    A world walks for a while under changing commands, stops, does a clip that begins as it stands, and walks on. Some
    begin lying, or along a clip. What is far from its clip for half a second has failed.
    """

    def __init__(self, robot: Robot, clips: Sequence[Clip], n: int, settings: TrackingSettings, seed: int) -> None:
        """Rolls the clips out first, which takes seconds. Raises ConfigError for clips of another robot."""
        self.robot, self.n, self.settings, self.clips = robot, n, settings, tuple(clips)
        self.reference = GaitOrClip(robot, clips, (n,), load_gait(settings.gait) if settings.gait else None)
        self.speeds = Speeds(robot, self.reference.gait if settings.faster else None)
        self._begins = np.array([clip.about.begins for clip in clips])
        self._lies = np.char.startswith(self._begins, "lying")
        wanted = settings.clip_share > 0.0
        self._along = along(robot, clips, _ALONG, seed) if wanted else None
        self._lying = lying(robot, _LYING, seed) if wanted and self._lies.any() else None
        self._ends = np.array([clip.about.ends for clip in clips])
        ends, begins = (np.array([clip.joints[at] for clip in clips]) for at in (-1, 0))
        self._near = np.sqrt(((ends[:, None] - begins) ** 2).mean(-1)) < _NEAR
        self._chances = np.full(len(clips), 0.5)  # of failure
        self._astray, self._since = np.zeros(n, int), np.zeros(n, int)  # ticks: far off; since the last change
        self._next_command, self._next_change = np.zeros(n, int), np.zeros(n, int)
        self._done_at = np.full(n, -1)  # tick of the episode at which a clip that is over gives way
        self._after = np.zeros(n, bool)  # stands, and did a clip before
        self._level = 1.0
        height, orientation = Legs(robot).stand(robot.home)
        self._stance = float(height), orientation  # of a base that stands at home
        self._pose: Array = robot.home
        self.closing = np.zeros(n, bool)  # nothing is known that begins as the last clip ended

    @property
    def on_clip(self) -> Array:
        """Which worlds follow a clip `(n,)`."""
        return self.reference.on_clip

    @property
    def phase(self) -> Array:
        return np.where(self.on_clip, self.reference.clip.phase, 0.0)

    @property
    def measures(self) -> Mapping[str, float]:
        """Share of tries that do well, of each clip, over the last some thirty, and how fast worlds are asked to go."""
        chances = {clip.name: float(chance) for clip, chance in zip(self.clips, self._chances, strict=True)}
        return {f"success/{name}": 1.0 - chance for name, chance in chances.items()} | dict(self.speeds.measures)

    def schedule(self, progress: float) -> None:
        """How fast clips are played grows over the first half of the training."""
        self._level = min(1.0, progress / 0.5)

    # -- how an episode begins -----------------------------------------------------------------------------------------

    def begin(self, where: Array, rngs: Sequence[np.random.Generator]) -> Start:
        """Draw how the worlds `where` `(n,)` bool begin; a row for every world. Call `enter` once they have begun."""
        joints = np.tile(self.robot.home, (self.n, 1))
        position = np.tile([0.0, 0.0, np.nan], (self.n, 1))
        orientation = np.full((self.n, 4), np.nan)
        velocity, turning = np.zeros((self.n, 3)), np.zeros((self.n, 3))
        joint_velocity = np.zeros_like(joints)
        self._first, self._first_time = np.full(self.n, -1), np.zeros(self.n)
        for i in np.flatnonzero(where).tolist():
            rng = rngs[i]
            if rng.random() >= self.settings.clip_share:
                continue
            clip = self._choose(rng, np.ones(len(self.clips), bool))
            states, row = self._state(clip, rng)
            if states is None:
                continue  # it begins as a walk does: standing, and goes over to some clip
            self._first[i], self._first_time[i] = clip, states.time[row]
            joints[i] = np.clip(states.joints[row], self.robot.lower, self.robot.upper)
            position[i], orientation[i] = states.position[row], states.orientation[row]
            velocity[i], turning[i] = states.velocity[row], states.angular_velocity[row]
            joint_velocity[i] = states.joint_velocity[row]
        self._pose = joints
        standing = np.isnan(orientation[:, 0])
        position[standing, 2], orientation[standing] = self._stance
        return Start(
            joints=joints, position=position, orientation=orientation, velocity=velocity, angular_velocity=turning,
            joint_velocity=joint_velocity,
        )  # fmt: skip

    def _state(self, clip: int, rng: np.random.Generator) -> tuple[States | None, int]:
        """Where to draw the beginning of a clip from, and the row there; None: it begins standing."""
        states = self._along
        if states is None:
            return None, 0
        fits = states.clip == clip
        if rng.random() < 0.5:
            if self._begins[clip] == "upright":
                return None, 0
            if self._lies[clip] and self._lying is not None:
                states, front = self._lying, self._lying.front
                sides = {"lying on the front": front, "lying on the back": ~front}
                fits = sides.get(str(self._begins[clip]), np.ones(len(front), bool))
        rows = np.flatnonzero(fits)
        return (states, int(rng.choice(rows))) if len(rows) else (None, 0)

    def enter(self, where: Array, rngs: Sequence[np.random.Generator]) -> None:
        """Begin the references of episodes that have begun in the worlds `where`."""
        self.reference.reset(where)
        self._astray[where] = self._next_command[where] = 0
        self._since[where] = round(_GRACE_SECONDS * self.robot.rate)  # whoever begins standing has fallen once it falls
        self._done_at[where], self.closing[where], self._after[where] = -1, False, False
        for i in np.flatnonzero(where).tolist():
            self._next_change[i] = self._walk_ticks(rngs[i], first=True)
        entered = where & (self._first >= 0)
        if entered.any():
            rates = np.array([self._rate(rngs[i], self._first[i]) if entered[i] else 1.0 for i in range(self.n)])
            first = np.maximum(self._first, 0)
            self._play(entered, first, self._pose, rates, self._first_time)

    def _rate(self, rng: np.random.Generator, clip: int) -> float:
        slow, fast = self.settings.get_up_rates if self._lies[clip] else self.settings.rates
        return float(rng.uniform(slow, 1.0 + (fast - 1.0) * self._level))

    def _walk_ticks(self, rng: np.random.Generator, first: bool = False) -> int:
        if rng.random() >= self.settings.clip_share:
            return 10**9  # this one walks on
        shortest = 0.2 if first else self.settings.walk_seconds[0]
        return round(rng.uniform(shortest, self.settings.walk_seconds[1]) * self.robot.rate)

    def _choose(self, rng: np.random.Generator, fits: Array) -> int:
        """A clip among those that fit, more often one that fails."""
        weights = (_ALWAYS + (1.0 - _ALWAYS) * self._chances) * fits
        return int(rng.choice(len(weights), p=weights / weights.sum()))

    def _play(self, where: Array, clip: Array, applied: Array, rates: Array, time: Array | float = 0.0) -> None:
        chosen = np.broadcast_to(time, self.n)[where] if np.ndim(time) else time
        self.reference.play(clip[where], applied, where, time=chosen, rate=rates[where])
        self._since[where] = self._astray[where] = 0
        self._done_at[where], self._after[where] = -1, False

    # -- a tick --------------------------------------------------------------------------------------------------------

    def look(self, state: State, applied: Array) -> None:
        """Nothing that is followed depends on it."""

    def led(self, target: Array) -> Array:
        return self.reference.led(target)

    def learn(self, measured: Array, asked: Array, failed: Array) -> None:
        walks = ~self.on_clip
        self.speeds.learn(asked[walks], measured[walks], failed[walks])

    def failed(self, truth: SimulatedTruth, frames: ReferenceFrames) -> Array:
        """Worlds `(n,)` whose episode is over, after a tick in which `frames` were to be reached."""
        off = ((truth.gravity + up_vector(frames.root_orientation[:, 0])) ** 2).sum(-1) > _ASTRAY_GRAVITY
        low = np.abs(truth.position[:, 2] - frames.height[:, 0]) > _ASTRAY_HEIGHT * self.robot.standing_height
        grace = self._since < _GRACE_SECONDS * self.robot.rate
        lies = self._lies[self.reference.clip.clip] & self.on_clip
        fallen = truth.fallen & ~self.on_clip
        astray = (np.where(self.on_clip, off | low, truth.fallen)) & ~(lies & grace)
        self._astray = np.where(astray, self._astray + 1, 0)
        # A robot that has just got up, or kneels beside its clip, may find its feet again; one that walks has fallen.
        patience = _ASTRAY_SECONDS * self.robot.rate
        failed = (self._astray > patience) | (fallen & ~grace)
        # Who falls just after a clip has not come to a stand from it.
        soon = self._after & (self._since < _AFTER_SECONDS * self.robot.rate)
        self._learn(failed & (self.on_clip | soon), 1.0)
        return failed

    def _learn(self, where: Array, failure: float) -> None:
        for clip in self.reference.clip.clip[where]:
            self._chances[clip] += _LEARNED * (failure - self._chances[clip])

    def go_on(self, ticks: Array, applied: Array, rngs: Sequence[np.random.Generator]) -> None:
        """By a tick: new commands, and other references where they are due."""
        self.reference.advance()
        self._since += 1
        rate = self.robot.rate
        command = self.reference.gait.target.copy()
        for i in np.flatnonzero(~self.on_clip & (ticks >= self._next_command)).tolist():
            command[i] = _draw(rngs[i], self.settings, self.robot.walking, self.speeds.walking)
            self._next_command[i] = ticks[i] + round(rngs[i].uniform(*self.settings.command_every) * rate)
        for i in np.flatnonzero(~self.on_clip & (ticks >= self._next_change) & (self._done_at < 0)).tolist():
            command[i] = 0.0
            self._next_command[i] = 10**9
            self._done_at[i] = ticks[i] + round(rngs[i].uniform(*_STOP_SECONDS) * rate)
        self.reference.gait.command(command)
        over = self.reference.ended & (self._done_at < 0)
        for i in np.flatnonzero(over).tolist():
            self._done_at[i] = ticks[i] + round(rngs[i].uniform(*_HOLD_SECONDS) * rate)
        due = (self._done_at >= 0) & (ticks >= self._done_at)
        if due.any():
            self._change(due, ticks, applied, rngs)

    def _change(self, due: Array, ticks: Array, applied: Array, rngs: Sequence[np.random.Generator]) -> None:
        ended = due & self.on_clip
        self._learn(ended, 0.0)
        pose = np.where(ended, self._ends[self.reference.clip.clip], "upright")
        stand = ended & (pose == "upright")
        next_clip, rates = np.zeros(self.n, int), np.ones(self.n)
        play = np.zeros(self.n, bool)
        for i in np.flatnonzero(due & ~stand).tolist():
            fits = self._begins == pose[i]
            if ended[i]:  # it sits, or lies, and who lies may come to any pose of lying
                fits = fits & (self._lies | self._near[self.reference.clip.clip[i]])
            if not fits.any():
                self.closing[i] = True
                continue
            next_clip[i] = self._choose(rngs[i], fits)
            rates[i], play[i] = self._rate(rngs[i], next_clip[i]), True
        if play.any():
            self._play(play, next_clip, applied, rates)
        if stand.any():
            self.reference.stand(applied, stand)
            self._after |= stand
            self._since[stand], self._done_at[stand], self._astray[stand] = 0, -1, 0
            for i in np.flatnonzero(stand).tolist():
                self._next_command[i] = ticks[i] + round(rngs[i].uniform(*_STOP_SECONDS) * self.robot.rate)
                self._next_change[i] = ticks[i] + self._walk_ticks(rngs[i])


def _draw(rng: np.random.Generator, s: TrackingSettings, walking: Walking, alone: Walking) -> Array:
    """A command `(3,)`: standing, straight ahead, along one other axis, backward, or any mixture; straight ahead and on
    the spot as fast as `alone` says."""
    command = rng.uniform(walking.lower, walking.upper)
    slowest, fastest = -walking.backward, walking.forward
    kind = rng.random()
    shares = np.cumsum([s.stand, s.forward, s.single, s.backward, s.turning])
    if kind < shares[0]:
        return np.zeros(3)
    if kind < shares[1]:
        fast = rng.uniform(alone.forward - (alone.forward - slowest) / 3, alone.forward)
        return np.array([fast if rng.random() < 0.5 else command[0], 0.0, 0.0])
    if kind < shares[2]:
        command[0] = rng.uniform(slowest, 0.0)
        return np.where(np.arange(3) == rng.integers(3), command, 0.0)
    if kind < shares[3]:
        command[0] = rng.uniform(slowest, 0.0)
    elif kind < shares[4]:
        return np.array([0.0, 0.0, command[2] * alone.turning / walking.turning])
    elif command[0] > _MIXED_SPEED * fastest:  # no fast walking while turning or side-stepping
        command[0] -= _MIXED_SPEED * fastest
    return command

"""What worlds do while data of skills is collected: they walk and stand, perform skills, and go from any to any."""

from __future__ import annotations

from collections.abc import Mapping, Sequence

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, State
from servoid.hw.contracts.world import Start
from servoid.hw.robot.description import Robot
from servoid.policy.references.either import GaitOrClip
from servoid.policy.text.captions import MOTIONS, NAMES, motion_of
from servoid.sim.truth import FALL_TILT, SimulatedTruth
from servoid.stack.control.base import BasePolicy
from servoid.stack.control.tracker import Tracker
from servoid.stack.skills.skill import UPRIGHT, Skill, clip_of, way
from servoid.tools.learn.collect.skills import FIRST_SECONDS, Drill, drawn, skills_of

STOP_SECONDS = (0.6, 1.2)  # that a robot that walks, or left a skill half done, is told to stand before another
REST_SECONDS = (0.0, 1.5)  # from the end of a skill until something else is told,
AT_ONCE = 0.3  # but for this share, which goes on at the clip's end
HOLD_SECONDS = 0.2  # of a clip's last frame, before the robot goes home
SETTLE_SECONDS = 1.2  # after a clip, for which its tracker stands
LEFT_SECONDS = 0.5  # that a skill lasts at least which is broken off
_STAND = NAMES.index("stand")


class Performances(BasePolicy):
    """What each of `n` worlds is told, and the policy that does it: a walk by `expert`, a skill by `tracker` or, where
    its file says so, by its clip alone.

    `skill` is the number of what a world is told, in `texts`; `velocity` what it is asked to walk at; `clock` the time
    since a skill began [s], 0 of a walk. Skills are drawn so that each gets as many ticks.
    """

    def __init__(
        self,
        robot: Robot,
        skills: Mapping[str, Skill],
        n: int,
        share: float = 0.7,
        expert: str = "expert",
        tracker: str = "tracker",
    ) -> None:
        """A share of the segments are skills. Raises ConfigError for a checkpoint that does not fit."""
        self.names, self._skills = tuple(skills), tuple(skills.values())
        self.texts = (*(m.phrasings[0] for m in MOTIONS), *(skill.phrases[0] for skill in self._skills))
        self._robot, self._share = robot, share
        self._drills = skills_of(robot)
        self._reference = GaitOrClip(robot, [clip_of(skill, robot) for skill in self._skills], (n,))
        self._walks, self._tracks = Tracker(robot, expert, (n,)), Tracker(robot, tracker, (n,), clips=True)
        self._alone = np.array([skill.policy == "clip" for skill in self._skills])
        self._low = np.array([skill.low for skill in self._skills])
        self._ends = np.array([skill.end for skill in self._skills])
        self._upright = np.array([skill.entry == UPRIGHT for skill in self._skills])
        self._ticks = np.array([clip.ticks for clip in self._reference.clip.clips])
        self.told = np.zeros(len(self._skills), int)  # ticks of each skill so far
        self.skill, self.velocity, self.clock = np.zeros(n, int), np.zeros((n, 3)), np.zeros(n)
        self.lower = np.zeros(n)  # m: skills are begun from walks upright
        self._now = np.full(n, -1)  # number of the skill that is told; -1: a walk
        self._since = np.zeros(n, int)  # ticks since it began
        self._over = np.full(n, 10**6)  # ticks since a clip was left
        self._left = np.zeros(n, int)  # ticks until something else is told
        self._coming = np.full(n, -1)  # skill that a stop is for
        self._first, self._play, self._stand = np.ones(n, bool), np.zeros(n, bool), np.zeros(n, bool)

    @property
    def columns(self) -> dict[str, Array]:
        """What a recording holds beside what is asked in walking, `(n, size)`."""
        return {"clock": self.clock[:, None]}

    def start(self, rngs: Sequence[np.random.Generator], where: Array) -> Start | None:
        """How the next episodes of the worlds `where` begin: standing."""
        return None

    def instruction(self, state: State, truth: SimulatedTruth) -> Instruction:
        """What whoever drives the worlds is told."""
        return Instruction(self.velocity, lower=self.lower)

    def fallen(self, truth: SimulatedTruth) -> Array:
        """Which worlds have fallen `(n,)`: one that sits down or rises by its tilt alone."""
        low = (self._now >= 0) & self._low[np.maximum(self._now, 0)]
        return np.where(low, -truth.gravity[:, 2] < np.cos(FALL_TILT), truth.fallen)

    # -- what is told --------------------------------------------------------------------------------------------------

    def begin(self, ids: Array) -> None:
        """Something is due in the worlds `ids`, which stand."""
        self._left[ids], self._first[ids], self._now[ids], self._coming[ids] = 0, True, -1, -1
        self._over[ids] = 10**6
        self.velocity[ids] = 0.0

    def advance(self, rngs: list[np.random.Generator]) -> None:
        """Tell what is due; call it once a tick, before `act`."""
        self._since += 1
        for i in np.flatnonzero(self._left == 0):
            self._next(int(i), rngs[i])
        self._left -= 1
        performs = self._now >= 0
        self.skill = np.where(performs, len(MOTIONS) + self._now, motion_of(self.velocity, self._robot.walking.scale))
        self.clock = np.where(performs, self._since * self._robot.dt, 0.0)
        self.told += np.bincount(self._now[performs], minlength=len(self.told))

    def _next(self, i: int, rng: np.random.Generator) -> None:
        now, coming = self._now[i], self._coming[i]
        if coming >= 0:
            self._perform(i, int(coming), rng)
        elif now >= 0 and self._ends[now] != UPRIGHT:
            rise = way(str(self._ends[now]), UPRIGHT, dict(zip(self.names, self._skills, strict=True)))[0]
            self._perform(i, self.names.index(rise.name), rng)
        elif self._first[i]:
            self._walk(i, self._drills[0], FIRST_SECONDS, rng)
        elif rng.random() >= self._share:
            drill = drawn(self._drills, rng)
            self._walk(i, drill, drill.seconds, rng)
        else:
            weights = self._upright / (50.0 + self.told)
            chosen = int(rng.choice(len(weights), p=weights / weights.sum()))
            if self.velocity[i].any() or (now >= 0 and self._since[i] < self._ticks[now]):
                self._walk(i, self._drills[0], STOP_SECONDS, rng)
                self._coming[i] = chosen
            else:
                self._perform(i, chosen, rng)
        self._first[i] = False

    def _walk(self, i: int, drill: Drill, seconds: tuple[float, float], rng: np.random.Generator) -> None:
        self.velocity[i] = drill.draw(rng)
        self._stand[i] |= self._now[i] >= 0
        self._now[i], self._since[i] = -1, 0
        self._left[i] = self._in_ticks(rng.uniform(*seconds))

    def _perform(self, i: int, skill: int, rng: np.random.Generator) -> None:
        self.velocity[i] = 0.0
        self._now[i], self._since[i], self._coming[i] = skill, 0, -1
        self._play[i], self._stand[i] = True, False
        whole = int(self._ticks[skill])
        if self._skills[skill].interrupted_by == "anything" and rng.random() < 0.4:
            self._left[i] = self._in_ticks(rng.uniform(LEFT_SECONDS, whole * self._robot.dt))
        else:
            rest = rng.uniform(*REST_SECONDS) * (rng.random() >= AT_ONCE)
            self._left[i] = whole + self._in_ticks(rest + (0.5 if self._ends[skill] != UPRIGHT else 0.0))

    def _in_ticks(self, seconds: float) -> int:
        return max(round(seconds * self._robot.rate), 1)

    # -- what is done --------------------------------------------------------------------------------------------------

    def reset(self, where: Array | None, seeds: Array) -> None:
        self._reference.reset(slice(None) if where is None else where)
        for tracker in (self._walks, self._tracks):
            tracker.reset(where)

    def act(self, state: State, applied: Array, instruction: Instruction) -> Array:
        reference, now = self._reference, np.maximum(self._now, 0)
        if self._play.any():
            reference.play(now[self._play], applied, self._play)
        done = (self._now >= 0) & (self._ends[now] == UPRIGHT) & reference.ended
        done &= self._since >= self._ticks[now] + round(HOLD_SECONDS * self._robot.rate)
        if (stand := (self._stand | done) & reference.on_clip).any():
            reference.stand(applied, stand)
        self._play[:], self._stand[:] = False, False
        self._over = np.where(reference.on_clip, 0, self._over + 1)
        reference.gait.command(instruction.velocity)
        walked, tracked = (tracker(state, applied, reference) for tracker in (self._walks, self._tracks))
        by_tracker = self._over <= SETTLE_SECONDS * self._robot.rate
        by_tracker &= ~instruction.velocity.any(-1) | reference.on_clip
        alone = reference.on_clip & self._alone[reference.clip.clip]
        goal = reference.frames(np.zeros(1, int)).position[:, 0]
        target = np.where(alone[:, None], goal, np.where(by_tracker[:, None], tracked, walked))
        reference.advance()
        return target

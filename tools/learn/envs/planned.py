"""The environment of a tracker's training in a closed loop, as in CLoSD: worlds follow plans that go on from what they
did, and are rewarded for following them alone, whatever they are asked.

The planner plans for all worlds at once, one call of its network a step of denoising.
"""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import replace

import numpy as np

from servoid.hw.config import ConfigError
from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import Instruction, ReferenceFrames, State
from servoid.hw.contracts.world import Start
from servoid.policy.mlp import Mlp
from servoid.policy.motion.clip import Clip
from servoid.policy.references.plan import PlanReference
from servoid.sim.model import build
from servoid.sim.truth import FALL_TILT, SimulatedTruth
from servoid.sim.worlds import Worlds
from servoid.stack.control.closed_loop import ClosedLoopSettings, closed_loop_policy, load_settings
from servoid.stack.control.fleet import Fleet
from servoid.stack.control.tracker import Walker
from servoid.tools.learn.envs.acts import EVERY, SCENE, Acts
from servoid.tools.learn.envs.score_term import AdversarialTerm
from servoid.tools.learn.envs.tracking import Tracking

_LEARNED = 0.03  # of a share of episodes, from one of them
_NOTHING = Instruction(np.zeros(3))  # of all worlds together: each is asked something else


class Plans:
    """Plans that the worlds of a fleet follow; see `Curriculum`."""

    def __init__(self, fleet: Fleet, acts: Acts, settings: ClosedLoopSettings, clips: Sequence[Clip]) -> None:
        """`clips` are those that the tracker has learned. Raises ConfigError where planner or walker do not fit."""
        robot, n = fleet.robot, fleet.n
        self._fleet, self._acts, self.clips = fleet, acts, clips
        self._asked: list[Instruction] = []
        alone = replace(settings, tracker="")  # what is trained tracks
        self._policy = closed_loop_policy(robot, alone, shape=(n,), each=lambda: self._asked)
        self._walker = Walker(robot, settings.walker, (n,)) if settings.walker else None
        self.on_clip, self.phase, self.closing = np.ones(n, bool), np.zeros(n), np.zeros(n, bool)
        self.tick = 0
        self._begun, self._failed = np.zeros(n, bool), np.zeros(n, bool)
        self._upright = dict.fromkeys(acts.names, 0.5)  # share of episodes without a fall
        self._walking = 0.0  # share of worlds
        self._state: State

    @property
    def reference(self) -> PlanReference:
        return self._policy.reference

    @property
    def measures(self) -> Mapping[str, float]:
        """Of each task, the share of episodes that ended without a fall, and how much the tracker of the gait walks."""
        upright = {f"upright/{name.replace(',', '-')}": share for name, share in self._upright.items()}
        return {**upright, "walking": self._walking}

    def schedule(self, progress: float) -> None:
        """Tasks are as hard as they are."""

    def begin(self, where: Array, rngs: Sequence[np.random.Generator]) -> Start:
        for i in np.flatnonzero(where & self._begun).tolist():
            name = self._acts.name(i)
            self._upright[name] += _LEARNED * (float(not self._failed[i]) - self._upright[name])
        self._begun = self._begun | where
        return self._acts.begin(where, rngs)

    def enter(self, where: Array, rngs: Sequence[np.random.Generator]) -> None:
        self._policy.reset(where, self._fleet.seeds)
        if self._walker is not None:
            self._walker.reset(where)
        self.closing[where] = False

    def look(self, state: State, applied: Array) -> None:
        self._state = state
        if self.tick % EVERY == 0:
            self._acts.look(state, self._fleet.truth)
        if self._policy.plans.due:
            self._asked = self._acts.told
        self._policy.follow(state, applied, _NOTHING)
        if events := self._policy.take_events():
            raise ConfigError(f"the planner does not plan: {events[0]}")

    def led(self, target: Array) -> Array:
        if self._walker is None:
            return target
        led = self._walker(target, self._state, self._fleet.applied, self.reference)
        self._walking += _LEARNED * (float(self._walker.share.mean()) - self._walking)
        return led

    def failed(self, truth: SimulatedTruth, frames: ReferenceFrames) -> Array:
        """Those that tip over, or touch the ground with anything but their feet: a plan goes on from what was done, so
        that a robot that falls is as its plan says."""
        self._failed = (truth.tilt > FALL_TILT) | truth.grounded
        self.closing = self._acts.over & ~self._failed
        return self._failed

    def learn(self, measured: Array, asked: Array, failed: Array) -> None:
        """Nothing grows with what is followed."""

    def go_on(self, ticks: Array, applied: Array, rngs: Sequence[np.random.Generator]) -> None:
        self._policy.advance()
        self.tick += 1


class PlannedTracking(Tracking):
    """`n` worlds in a closed loop with the planner that the settings name; see `Tracking`."""

    motions: Plans
    style: AdversarialTerm | None = None  # half of the reward, where there is one (AMP)
    _liked: Array | float = 0.0  # by it, at its last frame

    def learn(self) -> None:
        if self.style is not None:
            self.style.learn()

    def _reset(self, where: Array) -> None:
        super()._reset(where)
        if self.style is not None:
            self.style.reset(where)

    def _judge(self, frames: ReferenceFrames, failed: Array) -> Array:
        reward = super()._judge(frames, failed)
        if self.style is None:
            return reward
        if self.motions.tick % self.style.stride == 0:
            self._liked = self.style(self.fleet.state)
        return 0.5 * reward + 0.5 * self._liked

    def _fleet(self, odometry: Mlp | None, seed: int) -> Fleet:
        s = self.settings
        model = build(self.robot, SCENE)
        return Fleet(self.robot, Worlds(self.robot, self.n, randomise=s.randomised, model=model), odometry, seed=seed)

    def _followed(self, clips: Sequence[Clip], seed: int) -> Plans:
        acts = Acts(self.robot, self.n, self.settings, clips)
        settings = load_settings(self.settings.planner)
        if self.settings.teacher:  # whose pupil walks itself
            settings = replace(settings, walker="")
        return Plans(self.fleet, acts, settings, clips)

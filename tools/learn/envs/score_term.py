"""The prior's reward as a term with a memory and a network, and what fills its memory: generated start states."""

from __future__ import annotations

from collections.abc import Callable, Mapping
from dataclasses import dataclass
from pathlib import Path
from typing import TYPE_CHECKING, Any, TypeAlias

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.control import State
from servoid.hw.contracts.world import Start
from servoid.hw.geometry import up_vector
from servoid.hw.robot.legs import Legs
from servoid.policy.features import raw_row
from servoid.tools.learn.prior_settings import ScoreSettings
from servoid.tools.learn.terms import StatefulTerm

if TYPE_CHECKING:
    from torch import Tensor

    from servoid.policy.priors.adversarial.discriminator import Adversary, Discriminator
    from servoid.policy.priors.score_matching.model import Prior, Style

SMALLEST_REACH, LARGEST_REACH = 0.05, 0.5  # rad of joint target for an action of one
_DISCRIMINATOR = "discriminator.safetensors"  # beside the policy
_REACH = 2.0  # deviations of the data: exploration goes where the data goes
_SMOOTHING = 0.2  # of a decision's error in its running average by world


class Manner(StatefulTerm[State]):
    """How a policy moves, and how often it decides. This one judges nothing: without a prior all is as it should be."""

    def __init__(self, n: int, stride: int, reach: Array) -> None:
        """`stride`: ticks between decisions; `reach` `(n_joints,)`: rad of joint target for an action of one."""
        self.stride, self.reach = stride, reach
        self.prior: Prior | None = None
        self.box: Array | None = None  # (n, 7) as `Instruction.box`, now: of a task about one
        self.ratio = np.ones(n)  # of the error to that of held-out data, running average by world

    @property
    def measures(self) -> Mapping[str, float]:
        """What is logged of it."""
        return {}

    def shown(self, where: Array) -> Mapping[str, float]:
        """How often the worlds `where` `(n,)` bool show the style that is asked for, now; nothing where none is."""
        return {}

    def reset(self, where: Array) -> None:
        """New episodes in the worlds `where` `(n,)` bool."""

    def fill(self, where: Array, windows: Array) -> None:
        """They begin at the ends of `windows`."""

    def anneal(self, progress: float) -> None:
        """Judge as at `progress` of a training, 0 to 1."""

    def learn(self) -> Mapping[str, float]:
        """Once an update of the policy; returns what is logged."""
        return {}

    def state(self) -> dict[str, Any]:
        """What a training that goes on needs: plain numbers."""
        return {}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Inverse of `state`."""

    def keep(self, folder: Path, about: Mapping[str, Any]) -> None:
        """Write what it learned itself beside the policy, `about` into its header. Raises CheckpointError."""

    def __call__(self, step: State) -> Array:
        return np.ones(len(self.ratio))


class ScoreTerm(Manner):
    """How like its data a prior finds the last frames of `n` worlds, by the estimate: 0 to 1.

    Called once a frame of the prior.
    """

    def __init__(self, prior: Prior, style: Style, n: int, settings: ScoreSettings, seed: int) -> None:
        """Raises ConfigError for a style that the prior has not."""
        from servoid.policy.priors.score_matching.score import RunningMean, Score

        deviation = prior.joint_deviation
        super().__init__(n, prior.config.stride, np.clip(_REACH * deviation, SMALLEST_REACH, LARGEST_REACH))
        self.prior: Prior = prior
        self._settings = settings
        self._score, self._style = Score(prior, style, seed, settings.random_level), style
        self._judged: Tensor | None = None  # windows of the last call
        self._running = RunningMean(self._score.count)
        self.data_error = np.array([float(prior.header["results"]["error"])] * self._score.count)
        if not settings.random_level:
            names = ("error_high", "error_middle", "error_low")
            self.data_error = np.array([float(prior.header["results"][name]) for name in names])
        config = prior.config
        self._frames = np.zeros((n, config.frames, config.size), np.float32)  # oldest first
        self._yaw = np.zeros((n, config.frames))
        self._fresh = np.ones(n, bool)
        self.sharpness = settings.sharpness[0]

    @property
    def measures(self) -> Mapping[str, float]:
        """The prior's error in multiples of held-out data's, now."""
        return {"prior_ratio": float(self.ratio.mean())}

    def reset(self, where: Array) -> None:
        """The first frame of the worlds `where` is taken to have lasted, unless `fill` says otherwise."""
        self._fresh = self._fresh | where
        self.ratio[where] = 1.0

    def fill(self, where: Array, windows: Array) -> None:
        """The worlds `where` begin in the last frame of `windows` `(n, frames, size)`, which is the next to be seen."""
        self._frames[where] = np.concatenate([windows[:, :1], windows[:, :-1]], 1)[where]
        self._yaw[where] = 0.0
        self._fresh = self._fresh & ~where

    def state(self) -> dict[str, Any]:
        """What a training that goes on needs: plain numbers."""
        return {"mean": self._running.mean.tolist(), "samples": self._running.samples}

    def restore(self, saved: Mapping[str, Any]) -> None:
        """Inverse of `state`."""
        self._running.mean, self._running.samples = np.array(saved["mean"]), float(saved["samples"])

    def anneal(self, progress: float) -> None:
        """The sharpness changes over a training, geometrically."""
        first, last = self._settings.sharpness
        self.sharpness = first * (last / first) ** progress

    def shown(self, where: Array) -> Mapping[str, float]:
        return {} if self._judged is None else self.prior.shown(self._judged[where], self._style)

    def __call__(self, step: State) -> Array:
        windows = self._judged = self._windows(step)
        errors = self._score(windows)
        self.ratio = self.ratio + _SMOOTHING * ((errors / self.data_error).mean(-1) - self.ratio)
        return self._reward(windows, errors)

    def _reward(self, windows: Tensor, errors: Array) -> Array:
        """The term `(n,)` of the newest windows, whose errors `(n, count)` are known."""
        from servoid.policy.priors.score_matching.score import likeness

        scale = self._running(errors) if self._settings.scale == "running" else self.data_error
        return likeness(errors, scale, self.sharpness)

    def _windows(self, state: State) -> Tensor:
        """The windows `(n, frames, size)` that end in `state`, which they take in."""
        import torch

        from servoid.policy.priors.features import seen_from_last

        frame, yaw = self.prior.features.of(raw_row(state), self.box)
        self._frames = np.concatenate([self._frames[:, 1:], frame[:, None]], 1)
        self._yaw = np.concatenate([self._yaw[:, 1:], yaw[:, None]], 1)
        if self._fresh.any():
            self._frames[self._fresh] = frame[self._fresh][:, None]
            self._yaw[self._fresh] = yaw[self._fresh][:, None]
            self._fresh = np.zeros_like(self._fresh)
        return torch.from_numpy(seen_from_last(self._frames, self._yaw).astype(np.float32))


# What rewards in `n` worlds, made of a prior, a style, n, settings and a seed: `ScoreTerm`, or what takes its place.
MakesTerm: TypeAlias = "Callable[[Prior, Style, int, ScoreSettings, int], ScoreTerm]"


@dataclass(frozen=True)
class Rival:
    """A discriminator that rewards in the prior's place, and what teaches it; None: it stays as it is."""

    discriminator: Discriminator
    adversary: Adversary | None

    def term(self, prior: Prior, style: Style, n: int, settings: ScoreSettings, seed: int) -> AdversarialTerm:
        """A `MakesTerm`."""
        return AdversarialTerm(prior, style, n, settings, seed, self)


class AdversarialTerm(ScoreTerm):
    """The reward of a discriminator instead (AMP), frozen or learning; the prior measures the manner all the same."""

    def __init__(self, prior: Prior, style: Style, n: int, settings: ScoreSettings, seed: int, rival: Rival) -> None:
        super().__init__(prior, style, n, settings, seed)
        self.discriminator, self._adversary = rival.discriminator, rival.adversary

    def keep(self, folder: Path, about: Mapping[str, Any]) -> None:
        from servoid.policy.priors.adversarial.discriminator import save_discriminator

        if self._adversary is not None:
            save_discriminator(folder / _DISCRIMINATOR, self.discriminator, self.prior, about)

    def _reward(self, windows: Tensor, errors: Array) -> Array:
        if self._adversary is not None:
            self._adversary.memory.see(windows)
        return self.discriminator.reward(windows)

    def learn(self) -> dict[str, float]:
        return {} if self._adversary is None else self._adversary.learn()


class SmilingTerm(ScoreTerm):
    """SMILING's reward instead, which has no bound: see `OwnScore`; the prior measures the manner all the same."""

    def __init__(self, prior: Prior, style: Style, n: int, settings: ScoreSettings, seed: int) -> None:
        from servoid.policy.priors.adversarial.smiling import OwnScore

        super().__init__(prior, style, n, settings, seed)
        self.own = OwnScore(prior, seed, settings.random_level)

    def _reward(self, windows: Tensor, errors: Array) -> Array:
        return self.own.reward(windows, errors, self.data_error)

    def learn(self) -> Mapping[str, float]:
        return self.own.learn()


class GeneratedStarts:
    """A buffer of windows drawn from the prior, some of them replaced now and then; episodes begin at their ends."""

    def __init__(self, prior: Prior, style: Style, settings: ScoreSettings, seed: int) -> None:
        self._prior, self._style, self._settings, self._seed = prior, style, settings, seed
        self._next, self._filled = 0, 0
        self.windows = np.zeros((settings.starts, prior.config.frames, prior.config.size), np.float32)
        if settings.generated > 0.0:
            self._generate(settings.starts)

    def refresh(self) -> None:
        """Replace a quarter of the buffer, the oldest."""
        if self._settings.generated > 0.0:
            self._generate(max(self._settings.starts // 4, 1))

    def _generate(self, count: int) -> None:
        from servoid.policy.priors.score_matching.generate import generate

        rows = (self._next + np.arange(count)) % len(self.windows)
        self.windows[rows] = generate(self._prior, count, self._style, self._seed + self._filled).numpy()
        self._next, self._filled = (self._next + count) % len(self.windows), self._filled + 1

    def draw(self, rngs: list[np.random.Generator], where: Array) -> tuple[Array, Start]:
        """Windows `(n, frames, size)` that worlds begin at the end of, and these starts: drawn for the worlds `where`
        `(n,)` and the share of them that is not to stand."""
        from servoid.policy.priors.score_matching.generate import starts

        robot, config = self._prior.features.robot, self._prior.config
        share = [rng.random() if chosen else 1.0 for rng, chosen in zip(rngs, where, strict=True)]
        moving = where & (np.array(share) < self._settings.generated)
        picked = [rng.integers(len(self.windows)) if go else 0 for rng, go in zip(rngs, moving, strict=True)]
        windows = self.windows[np.array(picked, int)]
        windows = np.where(moving[:, None, None], windows, self._at_rest())
        start = starts(windows, self._prior.features, config.stride * robot.dt)
        return windows, start

    def _at_rest(self) -> Array:
        """A frame `(size,)` of a robot that stands."""
        features, robot = self._prior.features, self._prior.features.robot
        row, at = np.zeros(features.layout.size, np.float32), features.layout
        height, orientation = Legs(robot).stand(robot.home[None])
        row[at.slice("height")] = height
        row[at.slice("gravity")] = -up_vector(orientation[0])
        row[at.slice("position")] = robot.home
        row[at.slice("ends")] = features.limbs.ends(robot.home)
        return row

"""What learns does what its teacher would do wherever it comes itself (DAgger), by regression instead of by reward.

S. Ross et al., "A Reduction of Imitation Learning and Structured Prediction to No-Regret Online Learning" (2011).
"""

from __future__ import annotations

import time
from abc import abstractmethod
from collections.abc import Mapping
from pathlib import Path
from typing import TYPE_CHECKING

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.tools.learn.envs.task_environment import TaskEnvironment
from servoid.tools.learn.envs.tracking import Tracking
from servoid.tools.learn.prior_settings import PolicyTraining
from servoid.tools.learn.settings import Ppo, TrackerTraining
from servoid.tools.learn.teaching import Teacher
from servoid.tools.learn.trainers.policy import PolicyTrainer
from servoid.tools.learn.trainers.ppo import Environment, PpoTrainer, tensors
from servoid.tools.learn.trainers.tracker import TrackerTrainer

if TYPE_CHECKING:
    from servoid.policy.priors.score_matching.model import Style

_BATCH = 1024  # samples a step, and as many mirror images
_TURNS = 0.4, 2.5  # s for which the teacher of a task policy acts, or its pupil


class Taught(PpoTrainer):
    """The trainer of a pupil; a subclass says who teaches it, and for how long."""

    kept = 120_000  # samples that are learned from, the newest
    led = 0.15  # of the training over which the teacher acts, too, less and less often
    led_last = 0.0  # share of the time that it acts from then on

    def begin_lessons(self, env: Environment, settings: Ppo) -> None:
        """Once all else is there."""
        import torch

        self.critic_alone = 0.0  # no critic is asked
        self.columns = (*(name for name in self.columns if not name.startswith("loss/")), "loss/taught")
        self.panels = (*(panel for panel in self.panels if panel and "std" not in panel), ("loss/taught",))
        self._rng = np.random.default_rng(settings.seed)
        count = min(self.kept, 100 * settings.horizon * env.n)
        self._seen = torch.zeros(count, env.observations["actor"].shape[1])
        self._taught = torch.zeros(count, env.action_size)
        self._added = 0

    @abstractmethod
    def lesson(self, action: Array, led: float) -> tuple[Array, Array]:
        """Take a step, in which the teacher acts instead for a share `led` of the time. Returns the reward `(n,)`, and
        what the teacher would have done `(n, action_size)`."""

    def learn(self) -> dict[str, float]:
        """Collect `horizon` ticks in every world, and learn from what was collected of late."""
        import torch

        env, s = self.env, self.settings
        self._schedule()
        begun, rewards, terms = time.monotonic(), [], []
        passed = 1.0 if self.begun_with else min(1.0, self.step / (self.led * s.samples))
        led = 1.0 + passed * (self.led_last - 1.0)
        noise = float(self.ppo.actor.distribution.log_std_param.exp().mean())
        self.ppo.train_mode()
        with torch.inference_mode():
            for _ in range(s.horizon):
                seen = env.observations["actor"]
                self.ppo.actor.update_normalization(tensors(env))
                action = self.ppo.actor(tensors(env)).numpy()
                ticks = env.ticks + 1
                reward, taught = self.lesson(action + noise * self._rng.standard_normal(action.shape), led)
                self._keep(seen, taught)
                self.lengths.extend(ticks[env.ticks == 0].tolist())
                rewards.append(float(reward.mean()))
                terms.append(env.terms)
        collected = time.monotonic()
        losses = [self._improve() for _ in range(s.epochs * s.mini_batches)]
        self.step += s.horizon * env.n
        return {
            "episode_ticks": float(np.mean(self.lengths)) if self.lengths else 0.0,
            "reward": float(np.mean(rewards)),
            "std": noise,
            "learning_rate": self.ppo.learning_rate,
            "collect_share": (collected - begun) / (time.monotonic() - begun),
            "loss/taught": float(np.mean(losses)),
            **{f"term/{name}": float(np.mean([t[name] for t in terms])) for name in env.term_names},
            **env.measures,
        }

    def _keep(self, seen: Array, taught: Array) -> None:
        """Remember what was seen, and what the teacher would do; the oldest is forgotten."""
        import torch

        at = (self._added + torch.arange(len(seen))) % len(self._seen)
        self._seen[at] = torch.from_numpy(seen)
        self._taught[at] = torch.from_numpy(taught.astype(np.float32))
        self._added += len(seen)

    def _improve(self) -> float:
        """A step on samples and, unless a side counts, their mirror images; returns the mean squared error."""
        import torch
        from tensordict import TensorDict

        rows = torch.from_numpy(self._rng.integers(min(self._added, len(self._seen)), size=_BATCH))
        seen, taught = self._seen[rows], self._taught[rows]
        if self.settings.mirror > 0.0:
            seen = torch.cat([seen, self.env.mirrors["actor"](seen)])
            taught = torch.cat([taught, self.env.mirrors["action"](taught)])
        acted = self.ppo.actor(TensorDict({"actor": seen}, batch_size=[len(seen)]))
        loss = ((acted - taught) ** 2).mean()
        self.ppo.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.ppo.actor.mlp.parameters(), 1.0)
        self.ppo.optimizer.step()
        return float(loss.detach())


class TaughtTrainer(Taught, TrackerTrainer):
    """As `TrackerTrainer`, of an environment with a teacher."""

    def __init__(self, env: Tracking, settings: TrackerTraining, out: Path) -> None:
        super().__init__(env, settings, out)
        self.begin_lessons(env, settings)

    def lesson(self, action: Array, led: float) -> tuple[Array, Array]:
        taught = self.env.taught
        leads = self._rng.random(self.env.n) < led
        reward, _, _ = self.env.step(np.where(leads[:, None], taught, action))
        return reward, taught


class TaughtPolicyTrainer(Taught, PolicyTrainer):
    """As `PolicyTrainer`, with a teacher.

    It acts after each turn of its pupil: where a pupil stops for good, nothing else is seen any more.
    """

    LAST = "last.safetensors"
    kept, led, led_last = 300_000, 0.4, 0.5

    def __init__(
        self,
        env: TaskEnvironment,
        style: Style,
        settings: PolicyTraining,
        out: Path,
        prior: Path | None,
        teacher: Teacher,
    ) -> None:
        env.beside = self.teacher = teacher
        super().__init__(env, style, settings, out, prior)
        # Not all at the same part of the task: what is learned from would be that part.
        env.ticks[:] = np.random.default_rng(settings.seed).integers(0, env.limit, env.n)
        self.begin_lessons(env, settings)
        self._left = np.zeros(env.n, int)  # decisions of the present turns

    def score(self, results: Mapping[str, float]) -> tuple[float, float]:
        """The best return: a pupil that stops somewhere, where it did not before, does worse though it errs less."""
        return results.get("return", 0.0), float(self.step)

    def lesson(self, action: Array, led: float) -> tuple[Array, Array]:
        env = self.env
        over = self._left == 0
        turns = np.rint(self._rng.uniform(*_TURNS, env.n) / env.dt).astype(int)
        self._left = np.where(over, turns, self._left) - 1
        # The pupil after one of the teacher's turns, so often that the teacher acts for a share `led` of the time.
        leads = ~self.teacher.leads | (self._rng.random(env.n) * led >= 1.0 - led)
        self.teacher.leads = np.where(over, leads, self.teacher.leads)
        reward, _, _ = env.step(action)
        return reward, (self.teacher.taught() - env.robot.home) / env.reach

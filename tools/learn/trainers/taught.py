"""A tracker learns what its teacher would do wherever it comes itself (DAgger), by regression instead of by reward.

S. Ross et al., "A Reduction of Imitation Learning and Structured Prediction to No-Regret Online Learning" (2011).
"""

from __future__ import annotations

import time
from pathlib import Path

import numpy as np

from servoid.tools.learn.envs.tracking import Tracking
from servoid.tools.learn.settings import TrackerTraining
from servoid.tools.learn.trainers.ppo import tensors
from servoid.tools.learn.trainers.tracker import TrackerTrainer

_KEPT = 120_000  # samples that are learned from, the newest
_LED = 0.15  # of the training over which the teacher acts, too, less and less often
_BATCH = 1024  # samples a step, and as many mirror images


class TaughtTrainer(TrackerTrainer):
    """As `TrackerTrainer`, of an environment with a teacher."""

    def __init__(self, env: Tracking, settings: TrackerTraining, out: Path) -> None:
        import torch

        super().__init__(env, settings, out)
        self.critic_alone = 0.0  # no critic is asked
        terms = [f"term/{name}" for name in env.term_names]
        measured = ("episode_ticks", "reward", "std", "learning_rate", "samples_per_s", "collect_share", "loss/taught")
        self.columns = (*measured, *terms, *env.measures)
        self.panels = (("episode_ticks",), ("reward",), ("loss/taught",), terms, tuple(env.measures))
        self._rng = np.random.default_rng(settings.seed)
        count = min(_KEPT, 100 * settings.horizon * env.n)
        self._seen = torch.zeros(count, env.observation.size)
        self._taught = torch.zeros(count, env.action_size)
        self._added = 0

    def learn(self) -> dict[str, float]:
        """Collect `horizon` ticks in every world, and learn from what was collected of late."""
        import torch

        env, s = self.env, self.settings
        self._schedule()
        begun, rewards, terms = time.monotonic(), [], []
        led = 0.0 if self.begun_with else max(0.0, 1.0 - self.step / (_LED * s.samples))
        noise = float(self.ppo.actor.distribution.log_std_param.exp().mean())
        self.ppo.train_mode()
        with torch.inference_mode():
            for _ in range(s.horizon):
                self._keep()
                action = self.ppo.actor(tensors(env)).numpy()
                leads = self._rng.random(env.n) < led
                action = np.where(leads[:, None], env.taught, action) + noise * self._rng.standard_normal(action.shape)
                ticks = env.ticks + 1
                reward, _, _ = env.step(action)
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

    def _keep(self) -> None:
        """Remember what is seen now, and what the teacher would do; the oldest is forgotten."""
        import torch

        at = (self._added + torch.arange(self.env.n)) % len(self._seen)
        self._seen[at] = torch.from_numpy(self.env.observations["actor"])
        self._taught[at] = torch.from_numpy(self.env.taught.astype(np.float32))
        self._added += self.env.n
        self.ppo.actor.update_normalization(tensors(self.env))

    def _improve(self) -> float:
        """A step on samples and their mirror images; returns the mean squared error of actions."""
        import torch
        from tensordict import TensorDict

        rows = torch.from_numpy(self._rng.integers(min(self._added, len(self._seen)), size=_BATCH))
        seen, taught = self._seen[rows], self._taught[rows]
        seen = torch.cat([seen, self.env.mirrors["actor"](seen)])
        taught = torch.cat([taught, self.env.mirrors["action"](taught)])
        acted = self.ppo.actor(TensorDict({"actor": seen}, batch_size=[len(seen)]))
        loss = ((acted - taught) ** 2).mean()
        self.ppo.optimizer.zero_grad()
        loss.backward()
        torch.nn.utils.clip_grad_norm_(self.ppo.actor.mlp.parameters(), 1.0)
        self.ppo.optimizer.step()
        return float(loss.detach())

"""SMILING (Wu et al., arXiv:2410.13855), to compare with: how much better a denoiser of the policy's own windows
predicts the noise in one than the prior does.

The denoiser learns along with the policy, from its newest windows alone. Where the policy moves as the data does both
predict alike, and the reward is nought; where only the policy goes, the prior errs more, and it is negative.
"""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import replace

import torch

from servoid.hw.contracts.body import Array
from servoid.policy.diffusion.schedule import cosine_signal
from servoid.policy.priors.adversarial.memory import Memory
from servoid.policy.priors.score_matching.model import Prior, Style
from servoid.policy.priors.score_matching.network import PriorNetwork
from servoid.policy.priors.score_matching.score import Score

_RATE = 1e-3  # of Adam
_BATCH, _STEPS = 256, 8  # of an update


class OwnScore:
    """A denoiser like that of a prior, with its normalisation, of what a policy does."""

    def __init__(self, prior: Prior, seed: int, random_level: bool = False) -> None:
        """`seed` and `random_level` are those of the prior's own score: both then judge at the same noise."""
        with torch.random.fork_rng():
            torch.manual_seed(seed)
            self.network, self.memory = PriorNetwork(replace(prior.config, styles=())), Memory()
        self._prior, self._levels = prior, prior.config.levels
        own = replace(prior, network=self.network, classifier=None)
        self._score = Score(own, Style(), seed, random_level)
        self._signal = torch.as_tensor(cosine_signal(self._levels), dtype=torch.float32)
        self._optimiser = torch.optim.Adam(self.network.parameters(), _RATE)
        self._generator = torch.Generator().manual_seed(seed)

    def reward(self, windows: torch.Tensor, errors: Array, scale: Array) -> Array:
        """Mean over levels of (own error - prior's error) / scale `(n,)`, of the newest windows, which it remembers;
        `errors` `(n, count)` are the prior's."""
        self.memory.see(windows)
        found: Array = ((self._score(windows) - errors) / scale).mean(-1)
        return found

    def learn(self) -> Mapping[str, float]:
        """A few steps; returns the mean squared error of the noise."""
        seen, losses = self._prior.encode(self.memory.windows), []
        for _ in range(_STEPS):
            clean = Memory.drawn(seen, _BATCH, self._generator)
            levels = torch.randint(1, self._levels + 1, (_BATCH,), generator=self._generator)
            signal = self._signal[levels][:, None, None]
            noise = torch.randn(clean.shape, generator=self._generator)
            noisy = signal.sqrt() * clean + (1 - signal).sqrt() * noise
            loss = (self.network(noisy, levels, torch.zeros_like(levels)) - noise).square().mean()
            self._optimiser.zero_grad(set_to_none=True)
            loss.backward()
            self._optimiser.step()
            losses.append(loss.item())
        return {"own_loss": sum(losses) / len(losses)}

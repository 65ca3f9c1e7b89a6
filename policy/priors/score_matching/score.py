"""How unlike its data a prior finds a motion: the error of the noise that it predicts (SMP, sections 3.2 and 5.1)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from servoid.hw.contracts.body import Array
from servoid.policy.diffusion.schedule import cosine_signal
from servoid.policy.priors.score_matching.model import Prior, Style

SHARES = (0.44, 0.30, 0.16)  # of the noise levels, at which SMP compares
_BATCH = 768  # windows a call: larger ones leave the processor's cache


class Score:
    """Errors of windows at a fixed set of noise levels, or at one drawn for each window."""

    def __init__(self, prior: Prior, style: Style, seed: int, random_level: bool = False) -> None:
        """Raises ConfigError for a style that the prior has not."""
        self.prior, self.style, self.random_level = prior, style, random_level
        for name in (style.upper, style.lower):
            prior.config.style(name)
        n = prior.config.levels
        self.levels = torch.tensor(sorted({max(round(share * n), 1) for share in SHARES}, reverse=True))
        self._signal = torch.as_tensor(cosine_signal(n), dtype=torch.float32)
        self._generator = torch.Generator().manual_seed(seed)

    @property
    def count(self) -> int:
        """Errors of a window."""
        return 1 if self.random_level else len(self.levels)

    @torch.inference_mode()
    def __call__(self, windows: Tensor) -> Array:
        """Mean squared errors `(batch, count)` of windows in physical units. Raises ValueError for one with a NaN."""
        if not bool(torch.isfinite(windows).all()):
            raise ValueError("a window of motion is not finite, so no prior can judge it")
        clean = self.prior.encode(windows)
        return np.concatenate([self._errors(part) for part in torch.split(clean, _BATCH)])

    def _errors(self, clean: Tensor) -> Array:
        shape, count = clean.shape, self.count
        if self.random_level:
            levels = torch.randint(1, len(self._signal), (len(clean), 1), generator=self._generator)
        else:
            levels = self.levels.expand(len(clean), -1)
        noise = torch.randn(len(clean), count, *shape[1:], generator=self._generator)
        signal = self._signal[levels][..., None, None]
        noisy = signal.sqrt() * clean[:, None] + (1 - signal).sqrt() * noise
        predicted = self.prior.noise(noisy.flatten(0, 1), levels.flatten(), self.style)
        return (predicted.view_as(noise) - noise).square().mean((-1, -2)).numpy().astype(float)


class RunningMean:
    """The mean of all errors so far at each level: begins at 1, and stays where it is once `freeze_after` are in."""

    SMALLEST = 1e-4

    def __init__(self, count: int, freeze_after: float = 1e8) -> None:
        self.mean, self.samples, self._freeze_after = np.ones(count), 0.0, freeze_after

    def __call__(self, errors: Array) -> Array:
        """The mean `(count,)` with `errors` `(n, count)` among them."""
        if self.samples < self._freeze_after:
            total = self.samples + len(errors)
            self.mean = self.mean + (errors.mean(0) - self.mean) * (len(errors) / total)
            self.samples = total
        return np.maximum(self.mean, self.SMALLEST)


def likeness(errors: Array, scale: Array, sharpness: float) -> Array:
    """exp(-w mean over levels of error / scale) `(n,)`: SMP, equation 8 with its normalisation."""
    return np.exp(-sharpness * (errors / scale).mean(-1))

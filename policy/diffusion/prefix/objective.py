"""What the planner is trained for: the clean frames, and that they end where the target is."""

from __future__ import annotations

import torch
from torch import Tensor

from servoid.policy.diffusion.objective import UNTOLD, add_noise, token_error
from servoid.policy.diffusion.prefix.dataset import Batch, PlanWindows
from servoid.policy.diffusion.prefix.network import PlannerNetwork


def losses(
    network: PlannerNetwork, batch: Batch, windows: PlanWindows, signal: Tensor, generator: torch.Generator
) -> tuple[Tensor, Tensor]:
    """Squared error of the predicted clean frames, all at one noise level a window, and the target loss.

    The prefix stays clean. One window in ten is shown without its sentence, for classifier-free guidance.
    """
    config = network.config
    prefix, future = batch.frames[:, : config.prefix], batch.frames[:, config.prefix :]
    level = torch.randint(1, config.levels + 1, (len(future),), generator=generator)
    noisy = add_noise(future, level[:, None].expand(-1, config.frames), signal, generator)
    told = torch.rand(len(future), generator=generator) >= UNTOLD
    clean = network(torch.cat([prefix, noisy], 1), level, batch.target.encode(), batch.text, told).float()
    simple = token_error(clean, future, clean.new_ones(config.frames))
    with torch.autocast("cpu", enabled=False):  # kinematics want more digits than bf16 has
        missed = batch.target.loss(windows.kinematics, windows.normaliser.decode(clean))
    return simple, missed

"""The warm start of rolling inference: an earlier plan, moved on, is what the next one is denoised from.

The buffer of Diffuse-CLoC (section 3.2) is not kept here. A plan and the noise of its frames determine it, and the
noise of a frame depends on the seed and the frame's own tick alone. So a plan is a function of its request, which holds
the plan that runs, and needs no memory that a lost or late plan could spoil.
"""

from __future__ import annotations

from collections.abc import Sequence
from dataclasses import dataclass
from functools import lru_cache

import numpy as np
import torch
from torch import Tensor

from servoid.hw.contracts.body import Array
from servoid.hw.seeds import wide_seed
from servoid.policy.diffusion.model.config import DenoiserConfig
from servoid.policy.diffusion.schedule import DenoisingMatrix
from servoid.policy.features import Normaliser, joints_seen, to_tokens

_FRAME = 2**31  # sets the noise of frames apart from what is drawn for a plan


@dataclass(frozen=True)
class Previous:
    """Plans that were made `age` ticks before now."""

    age: int
    states: Array  # (batch, horizon, raw size)
    actions: Array  # (batch, actions, action size) as plans have them, the first one of those plans' tick
    ticks: Array  # (horizon,) of the states, ahead of those plans

    def states_at(self, ticks: Array) -> Array:
        """States `(batch, k, raw size)` float64 `ticks` `(k,)` ahead of now, between those planned where need be.

        There are `k` of them as long as the plans last: later ticks are left out.
        """
        wanted = ticks[ticks + self.age <= self.ticks[-1]] + self.age
        before = np.searchsorted(self.ticks, wanted, side="right") - 1
        after = np.minimum(before + 1, len(self.ticks) - 1)
        share = (wanted - self.ticks[before]) / np.maximum(self.ticks[after] - self.ticks[before], 1)
        states = self.states.astype(float)
        mixed: Array = states[:, before] + share[:, None] * (states[:, after] - states[:, before])
        return mixed


def clean_start(
    config: DenoiserConfig, states: Normaliser, actions: Normaliser, previous: Previous, present: Array
) -> tuple[Tensor, Tensor]:
    """What an earlier plan says of a window, normalised: states and actions, zero where it says nothing.

    `present` `(batch, raw size)` is now; the plan is seen from there.
    """
    batch, age = len(present), previous.age
    kept = previous.states_at(config.future_ticks)
    rows = to_tokens(kept, np.asarray(present, dtype=float), joints_seen(states))
    clean_states = torch.zeros(batch, len(config.state_ticks), config.state_size)
    clean_actions = torch.zeros(batch, len(config.action_ticks), config.action_size)
    first = config.history
    clean_states[:, first : first + rows.shape[1]] = states.encode(torch.from_numpy(rows.astype(np.float32)))
    now = first - 1
    going_on = torch.from_numpy(previous.actions[:, age:].astype(np.float32))
    clean_actions[:, now : now + going_on.shape[1]] = actions.encode(going_on)
    return clean_states, clean_actions


def frame_noise(config: DenoiserConfig, seeds: Sequence[Sequence[int]]) -> tuple[Tensor, Tensor]:
    """Noise `(batch, state tokens, features)` and `(batch, action tokens, features)` that belongs to the frames.

    Each of `seeds` is a seed, the tick of now, and further numbers. A frame is an action and the state after it; it
    keeps its noise when the tick goes on.
    """
    frames = (config.state_ticks - 1).tolist(), config.action_ticks.tolist()
    sizes, shape = (config.state_size, config.action_size), (len(seeds), -1)
    parts = []
    for kind in (0, 1):
        drawn = [
            _noise_of_frame(*sizes, int(seed), int(tick) + config.history + frame, *more)[kind]
            for seed, tick, *more in seeds
            for frame in frames[kind]
        ]
        parts.append(torch.from_numpy(np.concatenate(drawn).reshape(*shape, sizes[kind])))
    return parts[0], parts[1]


@lru_cache(maxsize=4096)  # the next plan asks for all of them but one again, and drawing takes longer than a call
def _noise_of_frame(state_size: int, action_size: int, *numbers: int) -> tuple[Array, Array]:
    generator = seeded(*numbers, _FRAME)
    return torch.randn(state_size, generator=generator).numpy(), torch.randn(action_size, generator=generator).numpy()


def renoise(
    clean: tuple[Tensor, Tensor], noise: tuple[Tensor, Tensor], matrix: DenoisingMatrix, signal: Array
) -> tuple[Tensor, Tensor]:
    """States and actions at the levels of the first row of `matrix`."""
    parts = []
    for x, drawn, levels in zip(clean, noise, (matrix.states[0], matrix.actions[0]), strict=True):
        a = signal[levels].astype(np.float32)[:, None]
        parts.append(torch.from_numpy(np.sqrt(a) * x.numpy() + np.sqrt(1 - a) * drawn.numpy()))
    return parts[0], parts[1]


def seeded(*numbers: int) -> torch.Generator:
    """A generator of its own for each sequence of numbers, none of them negative."""
    return torch.Generator().manual_seed(wide_seed(*numbers))

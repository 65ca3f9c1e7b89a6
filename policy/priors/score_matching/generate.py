"""Motion drawn from a prior: generated windows, and the start states that they end in (GSI: SMP, section 5.2)."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from servoid.hw.contracts.body import Array
from servoid.hw.contracts.world import Start
from servoid.hw.geometry import joined
from servoid.policy.diffusion.sampler import Known, Sampler
from servoid.policy.diffusion.schedule import cosine_signal, full_sequence
from servoid.policy.priors.features import PriorFeatures
from servoid.policy.priors.score_matching.model import Prior, Style

_FARTHEST = 5.0  # deviations from the mean: at the highest levels a clean window is a small number divided by a smaller


@torch.inference_mode()
def generate(prior: Prior, count: int, style: Style, seed: int) -> Tensor:
    """Windows `(count, frames, size)` in physical units: DDPM over all levels, by the core's sampler."""
    config = prior.config
    signal = cosine_signal(config.levels)
    cumulative = torch.as_tensor(signal, dtype=torch.float32)

    def predict(states: Tensor, actions: Tensor, levels: Tensor, _: Tensor) -> tuple[Tensor, Tensor]:
        level = levels.reshape(-1)[0]
        a = cumulative[level]
        noise = prior.noise(states, level.expand(len(states)), style)
        return ((states - (1 - a).sqrt() * noise) / a.sqrt()).clamp(-_FARTHEST, _FARTHEST), actions

    matrix = full_sequence(config.levels, config.levels, config.frames, 1)
    unknown = Known(
        torch.zeros(count, config.frames, config.size),
        torch.zeros(count, 1, 1),  # the core's windows have actions, too: here, one that nobody looks at
        torch.zeros(config.frames, dtype=torch.bool),
        torch.zeros(1, dtype=torch.bool),
    )
    generators = [torch.Generator().manual_seed(seed * 1_000_003 + i) for i in range(count)]
    states, _ = Sampler(predict, signal, eta=1.0).sample(matrix, unknown, generators)
    return prior.decode(states)


def starts(windows: Array, features: PriorFeatures, seconds: float) -> Start:
    """Bodies in the last frame of `windows` `(n, frames, size)`, `seconds` apart, put down on the ground.

    Joints keep within their ranges; their velocities are those between the last two frames.
    """
    robot, layout = features.robot, features.layout
    last = layout.split(windows[:, -1])
    joints = np.clip(windows[:, -2:, layout.slice("position")], robot.lower, robot.upper)
    at_rest = np.full((len(windows), 3), [0.0, 0.0, np.nan])
    return Start(
        joints=joints[:, -1],
        position=at_rest,
        orientation=upright(last["gravity"]),
        velocity=last["velocity"],
        angular_velocity=last["angular_velocity"],
        joint_velocity=(joints[:, -1] - joints[:, -2]) / seconds,
    )


def upright(gravity: Array) -> Array:
    """Quaternions `(..., 4)` of no yaw in which `gravity` `(..., 3)`, of any length, points down."""
    down = gravity / np.linalg.norm(gravity, axis=-1, keepdims=True)
    pitch = np.arcsin(np.clip(down[..., 0], -1.0, 1.0))
    roll = np.arctan2(-down[..., 1], -down[..., 2])
    cp, sp, cr, sr = np.cos(pitch / 2), np.sin(pitch / 2), np.cos(roll / 2), np.sin(roll / 2)
    return joined(cp * cr, cp * sr, sp * cr, -sp * sr)

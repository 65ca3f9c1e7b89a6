"""Deliberate disturbances while data is collected: action noise and pushes, different in each episode.

Noise moves the robot off the expert's path, and the label beside it says what the expert does there.
"""

from __future__ import annotations

from dataclasses import dataclass

import numpy as np

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot


@dataclass(frozen=True)
class DisturbanceSettings:
    """Angles rad (standard deviations), times s; `*_share` are shares of episodes."""

    noisy_share: float = 0.75
    slow_share: float = 0.25  # of the noisy ones: with noise that lasts as well
    pushed_share: float = 0.5
    upper: float = 0.045  # arms and head
    hip: float = 0.07
    knee: float = 0.09
    ankle: float = 0.11
    scale: tuple[float, float] = (0.2, 0.6)  # of an episode's noise
    slow_seconds: float = 0.25  # correlation time of the noise that lasts
    slow_size: float = 0.5  # of it, beside the white noise
    push_speed: tuple[float, float] = (0.0, 0.9)  # of the robot's top speed
    push_seconds: tuple[float, float] = (1.0, 3.0)  # between pushes


def joint_noise(robot: Robot, settings: DisturbanceSettings) -> Array:
    """Standard deviation `(n_joints,)` rad of a joint's action noise at scale 1.

    It rises toward the feet. Legs end in two ankle joints with the knee before them; what is above is the hip.
    """
    sizes = np.full(len(robot.joints), settings.upper)
    for leg in robot.leg_index:
        sizes[leg] = settings.hip
        sizes[leg[-3:-2]] = settings.knee
        sizes[leg[-2:]] = settings.ankle
    return sizes


class Disturbances:
    """Noise and pushes of `n` worlds, drawn from the worlds' own streams."""

    def __init__(self, robot: Robot, n: int, settings: DisturbanceSettings) -> None:
        self.settings, self._rate = settings, robot.rate
        self._speeds = robot.walking.forward * np.array(settings.push_speed)
        self._sizes = joint_noise(robot, settings)
        self._keep = float(np.exp(-robot.dt / settings.slow_seconds))
        self.scale = np.zeros(n)  # of the white noise; 0: a quiet episode
        self.slow_scale = np.zeros(n)
        self.pushed = np.zeros(n, bool)
        self._slow = np.zeros((n, len(robot.joints)))
        self._left = np.zeros(n, int)  # ticks until the next push

    def reset(self, ids: Array, rngs: list[np.random.Generator]) -> None:
        """Draw what befalls the new episodes of the worlds `ids`."""
        s = self.settings
        for i in ids:
            rng = rngs[i]
            noisy, slow, pushed = rng.random(3) < (s.noisy_share, s.slow_share, s.pushed_share)
            self.scale[i] = rng.uniform(*s.scale) * noisy
            self.slow_scale[i] = s.slow_size * self.scale[i] * slow
            self._slow[i] = rng.standard_normal(len(self._sizes))
            self.pushed[i] = pushed
            self._left[i] = self._pause(rng)

    def noise(self, rngs: list[np.random.Generator]) -> Array:
        """This tick's action noise `(n, n_joints)` rad: white, and an Ornstein-Uhlenbeck part where it lasts."""
        out = np.zeros_like(self._slow)
        for i in np.flatnonzero(self.scale):
            out[i] = self.scale[i] * rngs[i].standard_normal(len(self._sizes))
            if self.slow_scale[i]:
                fresh = rngs[i].standard_normal(len(self._sizes))
                self._slow[i] = self._keep * self._slow[i] + np.sqrt(1.0 - self._keep**2) * fresh
                out[i] += self.slow_scale[i] * self._slow[i]
        return out * self._sizes

    def push(self, rngs: list[np.random.Generator]) -> Array:
        """This tick's change of the bases' velocity `(n, 2)` m/s, world frame; zero where no push is due."""
        out = np.zeros((len(self.scale), 2))
        self._left -= self.pushed
        for i in np.flatnonzero(self.pushed & (self._left <= 0)):
            speed, angle = rngs[i].uniform(*self._speeds), rngs[i].uniform(-np.pi, np.pi)
            out[i] = speed * np.cos(angle), speed * np.sin(angle)
            self._left[i] = self._pause(rngs[i])
        return out

    def _pause(self, rng: np.random.Generator) -> int:
        return round(rng.uniform(*self.settings.push_seconds) * self._rate)

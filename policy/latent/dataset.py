"""Pairs of ticks that follow each other, drawn from a recording: what latent actions are learned from."""

from __future__ import annotations

import numpy as np
import torch
from torch import Tensor

from servoid.hw.contracts.body import Array
from servoid.hw.robot.description import Robot
from servoid.hw.robot.mirror import Mirror
from servoid.policy.features import Normaliser, raw_mirror
from servoid.policy.latent.actions import proprioception
from servoid.policy.recording import DatasetError, Recording


class Demonstrations:
    """States and the joint targets of their ticks: those that were decided, and those that ran, with noise."""

    def __init__(self, recording: Recording, robot: Robot, held_out: float = 0.02) -> None:
        """A share `held_out` of the episodes, evenly spread and at least one, is kept for validation.

        Raises DatasetError when there are not two episodes of two ticks.
        """
        spans = recording.spans
        spans = spans[spans[:, 1] - spans[:, 0] >= 2]
        if len(spans) < 2:
            raise DatasetError("latent actions need two episodes of two ticks or more; record longer ones")
        kept = np.arange(len(spans)) % max(2, round(1 / held_out)) == 0
        self.training, self.validation = (_firsts(spans[which]) for which in (~kept, kept))
        self._raw = torch.from_numpy(recording.raw)
        self._targets = [torch.from_numpy(x) for x in (recording.action, recording.applied)]
        self._mirror_raw, self._mirror_target = raw_mirror(robot), Mirror.joints(robot)
        self.states, self.actions = self._fit()

    def _fit(self, samples: int = 50_000) -> tuple[Normaliser, Normaliser]:
        """Normalisation over a fixed draw of ticks and their mirror images: of proprioception and of targets."""
        rows, targets = self.draw(samples, torch.Generator().manual_seed(0))
        fitted = (Normaliser.fit(x.flatten(0, 1).numpy()) for x in (proprioception(rows), targets))
        states, actions = (normaliser.to_torch() for normaliser in fitted)
        return states, actions

    def draw(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Raw rows `(batch, 2, raw size)` and targets `(batch, 2, n_joints)` rad of training ticks and the next ones.

        Half of the pairs have the targets that ran: at run time those are encoded as well. Half of the pairs are
        mirrored.
        """
        first = self.training[torch.randint(len(self.training), (batch,), generator=generator)]
        ran, mirrored = (torch.rand(2, batch, generator=generator) < 0.5)[..., None, None]
        rows = first[:, None] + torch.arange(2)
        raw, targets = self._raw[rows], torch.where(ran, self._targets[1][rows], self._targets[0][rows])
        return (
            torch.where(mirrored, self._mirror_raw(raw), raw),
            torch.where(mirrored, self._mirror_target(targets), targets),
        )

    def held_out(self, count: int) -> tuple[Tensor, Tensor]:
        """Up to `count` validation pairs as they were decided, the same every time."""
        pick = torch.linspace(0, len(self.validation) - 1, min(count, len(self.validation))).long()
        rows = self.validation[pick][:, None] + torch.arange(2)
        return self._raw[rows], self._targets[0][rows]


def _firsts(spans: Array) -> Tensor:
    """Rows that the next row follows in the same episode."""
    return torch.from_numpy(np.concatenate([np.arange(first, last - 1) for first, last in spans]))

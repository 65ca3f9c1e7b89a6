"""Training windows of a motion prior, from recordings by style."""

from __future__ import annotations

from collections.abc import Mapping
from dataclasses import dataclass

import numpy as np
import torch
from torch import Tensor

from servoid.hw.contracts.body import Array
from servoid.policy.priors.features import PriorFeatures, deviations, seen_from_last
from servoid.policy.priors.score_matching.network import PriorConfig
from servoid.policy.recording import DatasetError, Recording

HELD_OUT = 0.05  # share of the episodes, evenly spread
_MEASURED = 20_000  # windows that the normalisation is measured on


@dataclass(frozen=True)
class WindowSelection:
    """Which windows of its data a prior learns from."""

    standing: bool = False  # also those in which the robot was asked to stand throughout
    mirrored: bool = True  # their mirror images, too: half of all
    moving: float = 0.0  # rad that some joint comes far in each: a clip has poses that last
    seconds: float = 0.0  # of each style, 0 being all; those that are held out stay the same


class PriorWindows:
    """Windows, an index of their last frame each: they are gathered and mirrored when a batch is drawn."""

    def __init__(
        self,
        recordings: Mapping[str, Recording],
        features: PriorFeatures,
        config: PriorConfig,
        chosen: WindowSelection = WindowSelection(),
    ) -> None:
        """`recordings` by style; those of one that has none are under an empty name. Raises DatasetError where nothing
        is left to train on."""
        standing, moving, seconds = chosen.standing, chosen.moving, chosen.seconds
        self.config, self.features, self._sides = config, features, 2 if chosen.mirrored else 1
        span = (config.frames - 1) * config.stride
        frames, yaws, styles = [], [], []
        training: list[Array] = []
        validation: list[Array] = []
        start = 0
        for style, recording in recordings.items():
            rows, yaw = features.of(recording.raw, recording.box)
            frames.append(rows)
            yaws.append(yaw)
            presents = _presents(recording, span, standing)
            if moving > 0.0:
                joints = rows[:, features.layout.slice("position")]
                presents = [kept for last in presents if len(kept := last[_moves(joints, last, span, moving)])]
            last_rows = np.concatenate([*presents, np.zeros(0, int)])
            if not len(last_rows):
                asked = "" if standing else " in which the robot was not asked to stand"
                asked += f" and a joint comes {moving:g} rad far" if moving > 0.0 else ""
                raise DatasetError(
                    f"{style or 'data'}: no episode has the {span + 1} ticks of a window{asked}; record longer ones"
                )
            if len(presents) < 2:
                raise DatasetError(f"{style or 'data'}: one episode alone: two are needed, one of them to measure on")
            every = max(2, round(1 / HELD_OUT))
            left = round(seconds * features.robot.rate) or len(recording.raw)  # ticks
            for number, rows_of_episode in enumerate(presents):
                if number % every == 1:
                    validation.append(rows_of_episode + start)
                elif left > span:
                    training.append(rows_of_episode[: left - span] + start)
                    left -= len(training[-1]) + span
            styles.append(np.full(len(recording.raw), config.style(style or None)))
            start += len(recording.raw)
        self._frames, self._yaw = torch.from_numpy(np.concatenate(frames)), torch.from_numpy(np.concatenate(yaws))
        self._styles = torch.from_numpy(np.concatenate(styles))
        if not training:
            raise DatasetError(f"seconds {seconds:g}: shorter than the {span + 1} ticks of a window; learn from more")
        self.training, self.validation = (torch.from_numpy(np.concatenate(x)) for x in (training, validation))
        self._back = torch.arange(-config.frames + 1, 1) * config.stride
        generator = torch.Generator().manual_seed(0)
        pick = self.training[torch.randint(len(self.training), (_MEASURED,), generator=generator)]
        seen = torch.cat([self._gather(pick, torch.full((len(pick),), side)) for side in (False, True)[: self._sides]])
        mean, std = deviations(seen.reshape(-1, config.size).numpy(), features.layout)
        self.mean, self.std = torch.from_numpy(mean), torch.from_numpy(std)

    def _gather(self, last: Tensor, mirrored: Tensor) -> Tensor:
        rows = last[:, None] + self._back
        windows = seen_from_last(self._frames[rows], self._yaw[rows])
        return torch.where(mirrored[:, None, None], self.features.mirror(windows), windows)

    def draw(self, batch: int, generator: torch.Generator) -> tuple[Tensor, Tensor]:
        """Normalised windows `(batch, frames, size)`, half of them mirrored by chance where any are, and their styles
        `(batch,)`."""
        last = self.training[torch.randint(len(self.training), (batch,), generator=generator)]
        mirrored = torch.rand(batch, generator=generator) < 0.5 * (self._sides - 1)
        return (self._gather(last, mirrored) - self.mean) / self.std, self._styles[last]

    def held_out(self, count: int) -> tuple[Tensor, Tensor]:
        """Up to `count` normalised windows that were not trained on, the same every time, and their styles."""
        pick = torch.linspace(0, len(self.validation) - 1, min(count, len(self.validation))).long()
        last = self.validation[pick]
        return (
            self._gather(last, torch.arange(len(last)) % 2 >= 3 - self._sides) - self.mean
        ) / self.std, self._styles[last]


def _presents(recording: Recording, span: int, standing: bool) -> list[Array]:
    """The rows of each episode that are the last frame of a window of `span` ticks and one."""
    asked = np.concatenate([[0], np.cumsum(np.any(recording.command != 0.0, axis=1))])
    found = []
    for first, end in recording.spans:
        rows = np.arange(first + span, end)
        if not standing:
            rows = rows[asked[rows + 1] > asked[rows - span]]
        if len(rows):
            found.append(rows)
    return found


def _moves(joints: Array, last: Array, span: int, least: float) -> Array:
    """Whether any joint comes `least` rad far in the windows of `span` ticks and one that end at `last` `(n,)`: bool.
    `joints` `(ticks, n_joints)` rad."""
    windows = np.lib.stride_tricks.sliding_window_view(joints, span + 1, axis=0)[last - span]
    return np.asarray((windows.max(-1) - windows.min(-1)).max(-1) >= least)

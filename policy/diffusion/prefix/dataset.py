"""Windows to learn planning from: a prefix and the frames that follow it, what they are told, and where they end."""

from __future__ import annotations

from collections.abc import Mapping, Sequence
from dataclasses import dataclass, field, fields

import numpy as np
import torch
from torch import Tensor

from servoid.hw.contracts.body import Array
from servoid.policy.diffusion.prefix.config import PlannerShape
from servoid.policy.diffusion.prefix.frames import BodyMotion, Frames
from servoid.policy.diffusion.prefix.target import BodyTarget, drawn
from servoid.policy.features import Normaliser
from servoid.policy.motion.clip import other_side
from servoid.policy.recording import DatasetError
from servoid.policy.text.encoder import TextEncoder

HELD_OUT = 20  # one take in so many is kept for validation
ROOT = ("yaw_rate", "velocity", "height")  # what adds up over a plan, or is a number alone among so many
LATELY = 10  # frames within which what is asked has just changed
BEGINNINGS = 0.5  # share of windows that begin so
MEANWHILE = 4  # frames of a prefix, at most, that were not executed yet
Rows = tuple[Tensor, Tensor]  # first rows of a label's windows: all, and those that begin so
UNTOLD = -1  # a window over which what is asked changes


@dataclass
class Sequences:
    """Takes as frames: each `(frames, size)`, with the number of what each frame is called `(frames,)`.

    Servos lag behind what they are asked and smooth it, so that who plans on from what was executed must plan what was
    asked: `wanted` are the frames that were followed, where they are others than `frames`.
    """

    frames: list[Array] = field(default_factory=list)
    wanted: list[Array] = field(default_factory=list)
    label: list[Array] = field(default_factory=list)

    def add(self, frames: Frames, motion: BodyMotion, label: Array, wanted: BodyMotion | None = None) -> None:
        """Take in a motion at the robot's rate, called `label` `(ticks,)`: once for each tick that frames may begin
        at. `wanted` is what was followed in it, None: the same."""
        for first in range(frames.stride):
            every = slice(first, None, frames.stride)

            def relative(whole: BodyMotion, every: slice = every) -> Array:
                parts = (getattr(whole, part.name)[every] for part in fields(BodyMotion))
                return np.asarray(frames.to_relative(BodyMotion(*parts)), np.float32)

            self.frames.append(relative(motion))
            self.wanted.append(self.frames[-1] if wanted is None else relative(wanted))
            self.label.append(label[every][1:])


@dataclass(frozen=True)
class Batch:
    """Windows of a batch; frames are normalised."""

    frames: Tensor  # (batch, prefix + frames, size)
    text: Tensor  # (batch, words, text size), NaN where there is none
    target: BodyTarget


class ToldSentences:
    """Encoded phrasings of each label, and of its mirror image."""

    def __init__(self, told: Mapping[str, Sequence[str]], encoder: TextEncoder, words: int) -> None:
        sides = [[list(texts) for texts in told.values()], [[other_side(t) for t in texts] for texts in told.values()]]
        flat = [text for side in sides for texts in side for text in texts]
        self.texts = tuple(dict.fromkeys(flat))
        self.tokens = torch.from_numpy(encoder.tokens(flat, words))
        self._said = [texts[0] for texts in told.values()]
        counts = np.array([len(texts) for texts in told.values()])
        first = np.cumsum([0, *counts[:-1]])
        self._count = torch.from_numpy(counts)
        self._first = torch.from_numpy(np.stack([first, first + counts.sum()]))  # (2, labels)

    def of(self, label: Tensor, mirrored: Tensor, generator: torch.Generator) -> Tensor:
        """A phrasing of each label `(batch,)`, `(batch, words, size)`; all NaN for `UNTOLD`."""
        known = label.clamp_min(0)
        share = torch.rand(len(label), generator=generator)
        pick = self._first[mirrored.long(), known] + (share * self._count[known]).long()
        return torch.where((label == UNTOLD)[:, None, None], torch.nan, self.tokens[pick])

    def first(self, label: int) -> Tensor:
        """The first phrasing of a label `(words, size)`,"""
        return self.tokens[self._first[0, label]]

    def said(self, label: int) -> str:
        """and its words."""
        return self._said[label]


class PlanWindows:
    """Windows over takes, drawn as normalised batches: each label equally often, mirrored half of the time.

    Half of them begin when what is asked has just changed: there is little of that in takes, and in a run all hangs on
    it. The last frames of a prefix, up to `MEANWHILE`, and all that follow it are what was wanted, as in a loop, where
    the plan that runs meanwhile comes after what was executed.
    """

    def __init__(
        self,
        sequences: Sequences,
        frames: Frames,
        shape: PlannerShape,
        sentences: ToldSentences,
        untold: float,
        rest: int,
        root: float = 1.0,
    ) -> None:
        """`untold` is the share of windows that are told nothing since what is asked changes on the way.

        What is asked is that of the first frame to come. A motion may come to its end within the window, with `rest`,
        the label of standing, after it. Deviations of the `ROOT` count `root` times as much as others', as in
        HumanML3D: a small error of theirs adds up. Raises DatasetError without a window.
        """
        self.kinematics, self.shape, self.sentences, self._untold = frames, shape, sentences, untold
        length = shape.prefix + shape.frames
        rows, labels, held, begins, offset = [], [], [], [], 0
        for number, label in enumerate(sequences.label):
            if (count := len(label) - length + 1) > 0:
                ahead = np.lib.stride_tricks.sliding_window_view(label[shape.prefix :], shape.frames)[:count]
                rows.append(offset + np.arange(count))
                labels.append(asked(ahead, rest))
                past = np.lib.stride_tricks.sliding_window_view(label, shape.prefix)[:count, -LATELY:]
                begins.append((past != ahead[:, :1]).any(1))
                held.append(np.full(count, number % HELD_OUT == HELD_OUT - 1))
            offset += len(label)
        if not rows or not np.concatenate(held).any():
            raise DatasetError(f"fewer than {HELD_OUT} takes are longer than the {length} frames of a window")
        row, label, kept, new = (np.concatenate(each) for each in (rows, labels, held, begins))
        self._frames = torch.from_numpy(np.concatenate(sequences.frames))
        self._wanted = torch.from_numpy(np.concatenate(sequences.wanted))
        fitted = Normaliser.fit(np.concatenate([self._wanted.numpy(), frames.mirror(self._wanted.numpy())]))
        for name in ROOT:
            fitted.std[frames.layout.slice(name)] /= root
        self.normaliser = fitted.to_torch()
        self.count = int((~kept).sum())
        self._training, self._validation = (
            {int(k): _sorted(row, new, mine & (label == k)) for k in np.unique(label[mine])} for mine in (~kept, kept)
        )
        self._span = torch.arange(length)

    def draw(self, batch: int, generator: torch.Generator) -> Batch:
        """A training batch."""
        return self._draw(self._training, batch, generator)

    def held_out(self, batch: int) -> Batch:
        """Windows of takes that are not trained on, the same ones each time."""
        return self._draw(self._validation, batch, torch.Generator().manual_seed(0))

    @property
    def labels(self) -> list[int]:
        """Labels that windows are told, both of those trained on and of those held out."""
        return sorted(k for k in self._validation if k != UNTOLD and k in self._training)

    def labelled(self, batch: int, generator: torch.Generator, *, executed: bool) -> tuple[Batch, Tensor]:
        """A training batch that is all told, none of it mirrored, and its labels `(batch,)`; `executed`: as it was."""
        told = torch.tensor(self.labels)
        label = told[torch.randint(len(told), (batch,), generator=generator)]
        return self._of(self._training, label, generator, plain=True, executed=executed), label

    def held_out_of(self, label: Tensor, generator: torch.Generator) -> Batch:
        """Windows of labels `(batch,)` that are not trained on, none of them mirrored."""
        return self._of(self._validation, label, generator, plain=True)

    def _draw(self, windows: Mapping[int, Rows], batch: int, generator: torch.Generator) -> Batch:
        told = [k for k in windows if k != UNTOLD]
        label = torch.tensor(told)[torch.randint(len(told), (batch,), generator=generator)]
        if UNTOLD in windows:
            label = torch.where(torch.rand(batch, generator=generator) < self._untold, UNTOLD, label)
        return self._of(windows, label, generator)

    def _of(
        self, windows: Mapping[int, Rows], label: Tensor, generator: torch.Generator, *,
        plain: bool = False, executed: bool = False,
    ) -> Batch:  # fmt: skip
        """Windows of labels `(batch,)`; `plain`: not mirrored; `executed`: throughout."""
        batch = len(label)
        share, new = torch.rand(2, batch, generator=generator)
        rows = torch.stack([_one(windows[int(k)], s, n) for k, s, n in zip(label, share, new, strict=True)])
        mirrored = torch.rand(batch, generator=generator) < (0.0 if plain else 0.5)
        meanwhile = torch.randint(min(MEANWHILE, self.shape.prefix - 1) + 1, (batch,), generator=generator)
        at, before = rows[:, None] + self._span, self._span < self.shape.prefix - meanwhile[:, None]
        raw = torch.where((before | executed)[..., None], self._frames[at], self._wanted[at])
        raw = torch.where(mirrored[:, None, None], self.kinematics.mirror(raw), raw)
        target = drawn(self.kinematics, raw[:, self.shape.prefix :], generator)
        return Batch(self.normaliser.encode(raw), self.sentences.of(label, mirrored, generator), target)


def _sorted(row: Array, new: Array, mine: Array) -> Rows:
    begins = mine & new
    return torch.from_numpy(row[mine]), torch.from_numpy(row[begins if begins.any() else mine])


def _one(rows: Rows, share: Tensor, new: Tensor) -> Tensor:
    among = rows[int(new < BEGINNINGS)]
    return among[int(share * len(among))]


def asked(ahead: Array, rest: int) -> Array:
    """What windows are told `(windows,)`, of the labels of their frames to come `(windows, frames)`."""
    first = ahead[:, :1]
    same = ahead == first
    over = np.logical_and.accumulate(ahead[:, ::-1] == rest, axis=1)[:, ::-1]  # rests from here on
    return np.where((same | over).all(1), first[:, 0], UNTOLD)
